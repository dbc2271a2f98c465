"""Stored traces as arrays over sequence and slice, for many environments at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.statistics import SLICE_STATISTICS
from nl_env.trace_files import COLUMNS
from nl_env.trace_stream import TraceStream


class TraceStack:
    """The traces of a stream, each loaded when it is first wanted; images stay in their files.

    Args:
        stream: gives the traces.
        metrics: errors to keep.
        statistics: also keep :func:`nl_env.statistics.slice_statistics` of the images.

    Attributes:
        columns: per-slice columns by name, ``(S, K+1)`` each, for S sequences.
        errors: ``(len(metrics), S, K+1, P)`` float64, as in :class:`nl_env.traces.SequenceTrace`.
        statistics: ``(S, K+1, SLICE_STATISTICS)`` float32; empty unless asked for.
    """

    def __init__(self, stream: TraceStream, metrics: Sequence[str], statistics: bool) -> None:
        self._stream, self._metrics = stream, tuple(metrics)
        self.rows = {seed: row for row, seed in enumerate(stream.seeds)}
        shape = len(self.rows), stream.slices + 1
        self.columns = {name: np.zeros(shape, dtype) for name, dtype in COLUMNS.items()}
        self.errors = np.full((len(self._metrics), *shape, stream.lidar_period), np.nan)
        self.statistics = np.zeros((*shape, SLICE_STATISTICS if statistics else 0), np.float32)
        self._images: dict[int, NDArray[np.uint8]] = {}

    def row(self, seed: int) -> int:
        """Row of sequence ``seed`` in every array; loads it. ``ValueError`` as ``TraceStream.open``."""
        trace = self._stream.open(seed)
        row = self.rows[seed]
        if row not in self._images:
            for name, column in self.columns.items():
                column[row] = getattr(trace, name)
            for table, name in zip(self.errors, self._metrics, strict=True):
                table[row] = trace.errors[name]
            if self.statistics.size:
                self.statistics[row] = trace.statistics
            self._images[row] = trace.images
        return row

    def images(self, rows: NDArray[np.int64], indices: NDArray[np.int64]) -> NDArray[np.uint8]:
        """``(n, 1, H, W)`` uint8, a fresh copy of slices ``indices`` of ``rows``, both ``(n,)``."""
        batch = np.empty((len(rows), 1, *self._stream.camera.shape), np.uint8)
        for image, row, index in zip(batch, rows.tolist(), indices.tolist(), strict=True):
            image[0] = self._images[row][index]
        return batch

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_images": list(self._images)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        seeds = list(state["rows"])
        self.__dict__.update(state)
        self._images = {row: self._stream.open(seeds[row]).images for row in state["_images"]}
