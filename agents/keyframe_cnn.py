"""The trigger policy that asks a trained keyframe detector, and the loading of its weights."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import nl_env
from agents.base import Actions, Memory, Policy
from agents.keyframe_networks import ARCHITECTURES, Detector, FrameDetector
from nl_env.config import number
from nl_env.weight_files import load_network, load_strictly, read_card, read_tensors

WEIGHTS = Path(nl_env.__file__).parent / "weights"
FRAME_WEIGHTS = WEIGHTS / "keyframe-cnn.safetensors"
TEMPORAL_WEIGHTS = WEIGHTS / "keyframe-cnn-temporal.safetensors"

RELEASED_SIZE = (480, 640)
ANSWERS = 4096
"""Answers kept for every network: four sequences of 20 s, 2 MB."""
BLOCK_PIXELS = 256 * 120 * 160
"""Of the slices that pass through the network together when a whole sequence is scored."""


@dataclass(frozen=True)
class Loaded:
    """A network from a file, shared by the policies that use it.

    Attributes:
        network: in evaluation mode.
        thresholds: by name, as the card gives them; ``"default"`` is the operating point.
        answers: see :class:`Answers`.
    """

    network: Detector
    thresholds: Mapping[str, float]
    answers: Answers


class Answers:
    """The last answers to single slices: many thresholds on one sequence cost one pass of the network.

    The key is a digest of the event frame and the memory, on which alone an answer depends.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[bytes, tuple[NDArray[np.float32], Memory]] = OrderedDict()

    def get(
        self,
        frame: NDArray[np.int16],
        memory: Memory,
        compute: Callable[[NDArray[np.int16], Memory], tuple[NDArray[np.float32], Memory]],
    ) -> tuple[NDArray[np.float32], Memory]:
        """Logits and new memory of one slice, from ``compute`` where they are not known."""
        digest = hashlib.blake2b(repr(frame.shape).encode(), digest_size=16)
        digest.update(frame.tobytes())
        digest.update(memory.tobytes())
        key = digest.digest()
        if key not in self._known:
            self._known[key] = compute(frame, memory)
            if len(self._known) > ANSWERS:
                self._known.popitem(last=False)
        return self._known[key]


def load_detector(path: Path) -> Loaded:
    """The network at ``path`` and what its card says of thresholds; one that is loaded already is shared.

    A file without a card is taken for the released network's state dict (480x640, signed sums); the shape of
    its hidden layer tells the pooling.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file or its card does not fit; the message names both.
    """
    if not path.is_file():
        raise FileNotFoundError(f"weights: found no file {str(path)!r}; scripts/train_keyframe.py makes one")
    return _loaded(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=4)
def _loaded(path: Path, changed_ns: int) -> Loaded:
    if read_card(path) is None:
        return Loaded(_released(path), {}, Answers())
    network, card = load_network(path, ARCHITECTURES)
    assert isinstance(network, Detector)
    return Loaded(network, card.metrics.get("thresholds", {}), Answers())


def _released(path: Path) -> FrameDetector:
    tensors = read_tensors(path)
    hidden = tensors.get("fc1.weight")
    height, width = RELEASED_SIZE
    network = FrameDetector(height, width, pool=1, inputs="raw")
    if hidden is not None and hidden.shape != network.fc1.weight.shape:
        network = FrameDetector(height, width, pool=2, inputs="raw")
    load_strictly(network, tensors, path)
    network.eval()
    return network


class KeyframeCNN(Policy):
    """Trigger where the network's probability of "keyframe" exceeds ``threshold``.

    Event frames of another size are averaged down to the network's, which must divide them.

    Args:
        network: a :class:`Detector` in evaluation mode.
        threshold: of the probability, in [0, 1].
        threads: PyTorch's threads while the network runs.
        answers: of the same network, to share them with other policies.
    """

    def __init__(
        self, network: Detector, threshold: float = 0.5, threads: int = 1, answers: Answers | None = None
    ) -> None:
        number("threshold", threshold, 0.0, 1.0)
        number("threads", threads, 1, 256)
        self.network = network
        self.threshold = threshold
        self.threads = threads
        self._answers = answers or Answers()

    @classmethod
    def load(
        cls, path: str | Path = FRAME_WEIGHTS, threshold: float | None = None, threads: int = 1
    ) -> KeyframeCNN:
        """The policy with the weights at ``path``; the shipped ones of the paper's network by default.

        ``threshold=None`` takes the operating point that the weights' card gives (0.5 if it gives none).
        Errors as :func:`load_detector`.
        """
        loaded = load_detector(Path(path))
        if threshold is None:
            threshold = loaded.thresholds.get("default", 0.5)
        return cls(loaded.network, threshold, threads, loaded.answers)

    def initial_memory(self, count: int) -> Memory:
        """``(count, memory_size)`` float32 zeros."""
        return np.zeros((count, self.network.memory_size), dtype=np.float32)

    def decide(self, frames: NDArray[np.int16], memory: Memory) -> Actions:
        logits = self.logits(frames, memory)
        return (probability(logits[:, 0]) > self.threshold).astype(np.int64)

    def logits(self, frames: NDArray[np.int16], memory: Memory) -> NDArray[np.float32]:
        """Logits ``(n, outputs)`` for event frames ``(n, H, W)``; updates ``memory`` in place."""
        if len(frames) == 1:
            logits, after = self._answers.get(frames, memory, self._compute)
        else:
            logits, after = self._compute(frames, memory)
        memory[...] = after
        return logits.copy()

    def _compute(self, frames: NDArray[np.int16], memory: Memory) -> tuple[NDArray[np.float32], Memory]:
        pooled = torch.from_numpy(average_down(frames, self.network.size))
        with limited_threads(self.threads), torch.inference_mode():
            logits, after = self.network.step(pooled, torch.from_numpy(memory.copy()))
        return logits.numpy(), after.numpy()

    def score_sequence(self, frames: Any) -> NDArray[np.float32]:
        """``(K,)`` probabilities of "keyframe" for the event frames ``(K, H, W)`` of slices 1..K.

        The same numbers as from one prediction after the other, up to rounding, in less time. Any integer
        dtype will do, and so does anything with a length whose slices are such arrays: it is read in blocks.
        """
        memory = torch.zeros(1, self.network.memory_size)
        scores = []
        length = block_length(self.network.size)
        with limited_threads(self.threads), torch.inference_mode():
            for start in range(0, len(frames), length):
                pooled = average_down(frames[start : start + length], self.network.size)
                logits, memory = self.network.follow(torch.from_numpy(pooled)[None], memory)
                scores.append(probability(logits[0, :, 0].numpy()))
        return np.concatenate(scores) if scores else np.zeros(0, np.float32)


def block_length(size: tuple[int, int]) -> int:
    """Slices of ``size`` (H, W) that pass through a network together; bounds its memory."""
    return max(1, BLOCK_PIXELS // (size[0] * size[1]))


def probability(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """The logistic function."""
    return (1 / (1 + np.exp(-logits))).astype(np.float32)


def average_down(frames: NDArray[Any], size: tuple[int, int]) -> NDArray[np.float32]:
    """Event frames ``(n, H, W)`` as float32, averaged over blocks so that they measure ``size``.

    Raises:
        ValueError: ``size`` does not divide the frames, or not by the same factor along both axes.
    """
    count, height, width = frames.shape
    factor = height // size[0]
    if factor == 0 or (height, width) != (factor * size[0], factor * size[1]):
        raise ValueError(
            f"observation: found event frames of {height}x{width}, "
            f"expected a whole multiple of {size[0]}x{size[1]}, the size the detector was trained for"
        )
    if factor == 1:
        return frames.astype(np.float32)
    blocks = frames.reshape(count, size[0], factor, size[1], factor)
    return blocks.mean(axis=(2, 4), dtype=np.float32)


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Run PyTorch on ``threads`` threads; the number before comes back afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
