"""Two halves of a frame's work at once, in threads that are kept; compiled loops and NumPy let go of Python.

Results never depend on the number of threads: what runs at once is the same work on other arrays.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

from nl_env.depth.runtime.compiled import default_threads

WORTH = 120 * 160
"""Pixels from which an image is worth handing work to another thread (some 0.1 ms)."""

_MOST = 16
"""Threads that are kept, at most."""


class _Helpers:
    """Threads of the process at hand, made when they are first wanted."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None

    def start(self, task: Callable[[], None]) -> Future[None]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(_MOST, thread_name_prefix="depth")
        return self._pool.submit(task)

    def forget(self) -> None:
        """After a fork: the child has none of its parent's threads."""
        self._pool = None


_HELPERS = _Helpers()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_HELPERS.forget)


def usable_threads(shape: tuple[int, int], threads: int | None = None) -> int:
    """How many threads to use for an image of ``shape``.

    Args:
        shape: ``(H, W)``; small images are not worth a second one.
        threads: at most this many; default :func:`nl_env.depth.runtime.default_threads`. Never more than
            PyTorch is set to, where it is in use.
    """
    if shape[0] * shape[1] < WORTH:
        return 1
    torch = sys.modules.get("torch")
    threads = default_threads() if threads is None else threads
    return threads if torch is None else min(threads, torch.get_num_threads())


def together(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Run every task: with one thread here and in order, otherwise the first here and the others beside it.

    Returns when all have ended; raises what the first one that failed raised.
    """
    if threads < 2:
        for task in tasks:
            task()
        return
    first, *others = tasks
    started = [_HELPERS.start(task) for task in others]
    try:
        first()
    finally:
        wait(started)
    for future in started:
        future.result()
