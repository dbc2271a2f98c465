"""Batches by step number: which samples, in which order, made ahead of their use."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

AHEAD = 3
"""Batches made before they are asked for."""

_ORDER, _AUGMENTATION = 1, 2
"""Streams of random numbers that a training seed gives."""


class Source(Protocol):
    """Makes the batch of given samples."""

    @property
    def size(self) -> int:
        """Number of training samples."""
        ...

    def batch(self, indices: NDArray[np.int64], rng: np.random.Generator) -> Sequence[NDArray[Any] | Tensor]:
        """Arrays of the samples ``indices``; ``rng`` is for augmentation."""
        ...


@dataclass(frozen=True)
class Batches(Dataset[tuple[Tensor, ...]]):
    """The batch of every step, a function of the seed and the step alone.

    Epochs follow each other without a gap: a batch may begin in one and end in the next, and is always full.
    """

    source: Source
    batch_size: int
    seed: int

    def __getitem__(self, step: int) -> tuple[Tensor, ...]:
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(_AUGMENTATION, step)))
        arrays = self.source.batch(self.indices(step), rng)
        return tuple(
            array if isinstance(array, Tensor) else torch.from_numpy(np.ascontiguousarray(array))
            for array in arrays
        )

    def indices(self, step: int) -> NDArray[np.int64]:
        """Samples of ``step``, ``(batch_size,)``."""
        size = self.source.size
        places = np.arange(step * self.batch_size, (step + 1) * self.batch_size)
        epochs, within = np.divmod(places, size)
        chosen = np.empty(self.batch_size, np.int64)
        for epoch in np.unique(epochs):
            mine = epochs == epoch
            chosen[mine] = _permutation(self.seed, int(epoch), size)[within[mine]]
        return chosen

    def ahead(self, first: int, last: int, workers: int) -> Generator[tuple[Tensor, ...], None, None]:
        """Batches of the steps ``first`` to ``last - 1``, made by a thread or by ``workers`` processes.

        Processes are spawned and get a pickle of the source, which should open its files lazily.
        """
        if workers:
            loader = DataLoader(
                self,
                batch_size=None,
                sampler=range(first, last),
                num_workers=workers,
                prefetch_factor=AHEAD,
                multiprocessing_context="spawn",
            )
            yield from loader
            return
        with ThreadPoolExecutor(1, thread_name_prefix="batches") as pool:
            waiting: deque[Future[tuple[Tensor, ...]]] = deque()
            try:
                for step in range(first, min(first + AHEAD, last)):
                    waiting.append(pool.submit(self.__getitem__, step))
                for step in range(first + AHEAD, last + AHEAD):
                    batch = waiting.popleft().result()
                    if step < last:
                        waiting.append(pool.submit(self.__getitem__, step))
                    yield batch
            finally:
                for future in waiting:
                    future.cancel()


@lru_cache(maxsize=4)
def _permutation(seed: int, epoch: int, size: int) -> NDArray[np.int64]:
    """Order of the samples in ``epoch``."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ORDER, epoch)))
    return rng.permutation(size)
