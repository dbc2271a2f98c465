"""What every runtime makes of a network, and which runtimes there are."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = tuple[NDArray[np.float32], ...]
Run = Callable[[Sequence[NDArray[np.float32]]], Sequence[NDArray[Any]]]

PRECISIONS = {
    "torch": ("fp32",),
    "cuda": ("fp16", "fp32"),
    "openvino": ("fp32", "bf16"),
    "onnxruntime": ("fp32",),
}
"""What every runtime can compute in, its default first."""
RUNTIMES = ("auto", *PRECISIONS)
THREADS = 2
"""Threads of a network by default, at most: the networks are too small to gain from more."""


class CompiledNetwork:
    """A network ready to run on arrays of fixed shapes; call it with them.

    The arrays it returns are its caller's, never reused. The same inputs give the same bytes in every
    process of one machine with the same number of threads. Not thread-safe, not picklable.

    Attributes:
        runtime, precision, threads: what it runs with.
        shapes: shapes of its inputs.
    """

    def __init__(
        self, run: Run, shapes: Sequence[tuple[int, ...]], runtime: str, precision: str, threads: int
    ) -> None:
        self.runtime, self.precision, self.threads = runtime, precision, threads
        self.shapes = tuple(tuple(shape) for shape in shapes)
        self._run = run

    def __call__(self, *inputs: NDArray[np.float32]) -> Arrays:
        """The network's outputs as float32 arrays.

        Raises:
            ValueError: another number of arrays, another shape, or not float32.
        """
        if len(inputs) != len(self.shapes):
            raise ValueError(f"inputs: found {len(inputs)} arrays, expected {len(self.shapes)}")
        for k, (array, shape) in enumerate(zip(inputs, self.shapes, strict=True)):
            if array.shape != shape or array.dtype != np.float32:
                raise ValueError(
                    f"input {k}: found {array.dtype} {array.shape}, expected float32 {shape}, "
                    "which the network was compiled for"
                )
        outputs = self._run([np.require(array, requirements=("C", "W")) for array in inputs])
        return tuple(np.array(output, np.float32, order="C") for output in outputs)


def check_choice(runtime: str, precision: str | None = None) -> tuple[str, str]:
    """The runtime and precision meant by the arguments of :func:`compile_network`.

    Raises:
        ValueError: unknown runtime, or a precision it does not have.
        ImportError: ``"auto"`` without PyTorch.
    """
    if runtime not in RUNTIMES:
        raise ValueError(f"runtime: found {runtime!r}, expected one of {', '.join(RUNTIMES)}")
    if runtime == "auto":
        import torch

        runtime = "cuda" if torch.cuda.is_available() else "torch"
    offered = PRECISIONS[runtime]
    if precision is not None and precision not in offered:
        raise ValueError(
            f"precision: found {precision!r} with runtime {runtime!r}, expected {' or '.join(offered)}"
        )
    return runtime, precision or offered[0]


def default_threads() -> int:
    """Two, or fewer where the process may use fewer cores or ``OMP_NUM_THREADS`` says so."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(THREADS, cores, int(wanted) if wanted.isdigit() else THREADS))
