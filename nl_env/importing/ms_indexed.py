"""HDF5 events with an index by millisecond, as DSEC, M3ED and EvTTC publish them: lazy, checked slices."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.importing.source import Calibration, EventChecker, between

MS_US = 1000
CAMERAS = ("left", "right")
BLOCK_MS = 20
"""Milliseconds that :meth:`MsIndexedEvents.blocks` reads at a time."""


@dataclass(frozen=True)
class Layout:
    """Where a data set keeps its events.

    Attributes:
        name: of the data set.
        group: holds ``x``, ``y``, ``t``, ``p``.
        index: dataset with the number of the first event at or after every millisecond.
        offset: dataset with the time to add to ``t``, us, or None.
        shape: ``(H, W)`` of the sensor where the file does not say.
    """

    name: str
    group: str
    index: str
    offset: str | None = None
    shape: tuple[int, int] | None = None


def layouts(camera: str) -> tuple[Layout, ...]:
    """The known layouts; those with two cameras in a file for ``camera``."""
    m3ed, evttc = f"prophesee/{camera}", f"prophesee/event_cam_{camera}"
    return (
        Layout("DSEC", "events", "ms_to_idx", "t_offset", (480, 640)),
        Layout("M3ED", m3ed, f"{m3ed}/ms_map_idx"),
        Layout("EvTTC", evttc, f"{evttc}/ms_map_idx"),
    )


def load_filters() -> None:
    """Make the compression filters of ``hdf5plugin`` known to HDF5 where that package is installed."""
    with contextlib.suppress(ImportError):
        importlib.import_module("hdf5plugin")


def find_layout(file: h5py.File, camera: str) -> Layout | None:
    """The layout of an open file, or None."""
    for layout in layouts(camera):
        if f"{layout.group}/t" in file and layout.index in file:
            return layout
    return None


class MsIndexedEvents:
    """One camera of a DSEC, M3ED or EvTTC file; an :class:`nl_env.importing.EventSource`.

    Only the index is held in memory (8 bytes per millisecond), and every read compares it with the times it
    leads to. Every process opens the file for itself; pickles as its path.

    Args:
        path: the file.
        camera: ``"left"`` or ``"right"`` where a file holds both; DSEC has a file for each.

    Raises:
        FileNotFoundError: no such file.
        ValueError: none of the layouts, columns that are missing or of different lengths, an index that is
            no index, or a first event before time 0.
    """

    def __init__(self, path: str | Path, camera: str = "left") -> None:
        choice("camera", camera, CAMERAS)
        self.path = Path(path)
        self.camera = camera
        load_filters()
        self._reader = Hdf5Reader(self.path)
        layout = find_layout(self._reader.file, camera)
        if layout is None:
            expected = "; ".join(
                f"{known.group}/t and {known.index} ({known.name})" for known in layouts(camera)
            )
            raise ValueError(f"{self.path}: found no events of the {camera} camera, expected {expected}")
        self._layout = layout
        self.layout = layout.name
        self._rows = self._count_rows()
        self._index = self._read_index()
        offset = layout.offset
        self.offset_us = int(self._scalar(offset)) if offset and offset in self._reader.file else 0
        self.shape, self.calibration = self._sensor()
        self._span = self._read_span()

    def __len__(self) -> int:
        return self._rows

    def span(self) -> tuple[int, int]:
        """Times of the first and of the last event, us, ``t_offset`` included."""
        return self._span

    def events(self, start_us: int, stop_us: int) -> NDArray[np.void]:
        """Events of ``[start_us, stop_us)``; all of them are in memory at once.

        Raises:
            ValueError: a reversed window, damage, or times that contradict the index.
        """
        if not start_us < stop_us:
            raise ValueError(f"stop_us: found {stop_us} with start_us = {start_us}, expected a later time")
        start, stop = start_us - self.offset_us, stop_us - self.offset_us
        start_ms, stop_ms = start // MS_US, -(-stop // MS_US)
        # One more on either side, which the index must leave out. The index may end before the events do.
        first = max(int(self._index[min(max(start_ms, 0), len(self._index) - 1)]) - 1, 0)
        last = int(self._index[max(stop_ms, 0)]) + 1 if stop_ms < len(self._index) else self._rows
        checker = EventChecker(f"{self.path}: {self._layout.group}", self.shape)
        events = checker(first, *(self._column(name, first, last) for name in "txyp"))
        self._compare_index(start_ms, stop_ms, first, events["t"])
        events = between(events, start, stop)
        events["t"] += self.offset_us
        return events

    def blocks(self, start_us: int, stop_us: int) -> Iterator[NDArray[np.void]]:
        """Events of ``[start_us, stop_us)``, 20 ms at a time; raises as :meth:`events`."""
        step = BLOCK_MS * MS_US
        for t in range(start_us, stop_us, step):
            yield self.events(t, min(t + step, stop_us))

    def verify(self) -> None:
        """Read everything and compare all of the index with it.

        Raises:
            ValueError: the first damage.
        """
        for _ in self.blocks(self.offset_us, self._span[1] + 1):
            pass

    def close(self) -> None:
        """Close the file; it opens again when it is needed. May be called twice."""
        self._reader.close()

    def __reduce__(self) -> tuple[type[MsIndexedEvents], tuple[Path, str]]:
        return MsIndexedEvents, (self.path, self.camera)

    def _column(self, name: str, first: int, last: int) -> NDArray[Any]:
        return self._reader.read(f"{self._layout.group}/{name}", slice(first, last))

    def _count_rows(self) -> int:
        group = self._layout.group
        rows = {}
        for name in "txyp":
            dataset = self._reader.dataset(f"{group}/{name}")
            if dataset.ndim != 1 or dataset.dtype.kind not in "iub":
                raise ValueError(
                    f"{self.path}: {group}/{name}: found {dataset.dtype} {dataset.shape}, "
                    "expected one integer per event"
                )
            rows[name] = len(dataset)
        if len(set(rows.values())) > 1 or not rows["t"]:
            raise ValueError(
                f"{self.path}: {group}: found {rows} events, expected as many of each, at least 1"
            )
        return rows["t"]

    def _read_index(self) -> NDArray[np.int64]:
        name = self._layout.index
        dataset = self._reader.dataset(name)
        if dataset.ndim != 1 or dataset.dtype.kind not in "iu" or len(dataset) == 0:
            raise ValueError(
                f"{self.path}: {name}: found {dataset.dtype} {dataset.shape}, expected one integer per ms"
            )
        index = self._reader.read(name, slice(None)).astype(np.int64)
        if index[0] != 0 or index[-1] > self._rows or np.any(np.diff(index) < 0):
            raise ValueError(
                f"{self.path}: {name}: found event numbers from {index[0]} to {index[-1]} "
                f"(smallest step {np.diff(index).min(initial=0)}), "
                f"expected them to ascend from 0 to at most {self._rows}"
            )
        return index

    def _read_span(self) -> tuple[int, int]:
        first = int(self._column("t", 0, 1)[0])
        last = int(self._column("t", self._rows - 1, self._rows)[0])
        where = f"{self.path}: {self._layout.group}/t"
        if first < 0 or last < first:
            raise ValueError(
                f"{where}: found times from {first} to {last} us, expected them to ascend from 0"
            )
        ms = last // MS_US  # events later than the index knows would all be read at once
        if len(self._index) < ms:
            raise ValueError(
                f"{self.path}: {self._layout.index}: found {len(self._index)} ms, "
                f"expected {ms} or more, because the last event is at {last} us"
            )
        if np.any(self._index[ms + 1 :] != self._rows):
            raise ValueError(
                f"{self.path}: {self._layout.index}: found events after {ms} ms, "
                f"expected none, because the last event is at {last} us"
            )
        return first + self.offset_us, last + self.offset_us

    def _compare_index(self, start_ms: int, stop_ms: int, first: int, times: NDArray[np.int64]) -> None:
        """Compare the index of ``start_ms`` to ``stop_ms`` with the times of the events from ``first`` on."""
        ms = np.arange(max(start_ms, 1), min(stop_ms, len(self._index) - 1) + 1)
        found, expected = self._index[ms], first + np.searchsorted(times, ms * MS_US)
        if not np.array_equal(found, expected):
            k = int(np.argmax(found != expected))
            raise ValueError(
                f"{self.path}: {self._layout.index}[{ms[k]}]: found event {found[k]}, "
                f"but {self._layout.group}/t says {expected[k]} is the first at or after {ms[k]} ms"
            )

    def _sensor(self) -> tuple[tuple[int, int], Calibration | None]:
        """Size and intrinsics, from ``calib`` beside the events where the layout has it."""
        group = f"{self._layout.group}/calib"
        calibration = None
        if f"{group}/intrinsics" in self._reader.file:
            fx, fy, cx, cy = self._numbers(f"{group}/intrinsics", 4)
            if not (fx > 0 and fy > 0):
                raise ValueError(
                    f"{self.path}: {group}/intrinsics: found focal lengths {fx}, {fy}, expected > 0"
                )
            calibration = Calibration((fx + fy) / 2, cx, cy)
        if self._layout.shape is not None:
            return self._layout.shape, calibration
        width, height = (int(value) for value in self._numbers(f"{group}/resolution", 2))
        if width < 1 or height < 1:
            raise ValueError(f"{self.path}: {group}/resolution: found {width}, {height}, expected pixels")
        return (height, width), calibration

    def _numbers(self, name: str, count: int) -> list[float]:
        values = self._reader.read(name, slice(None)) if self._reader.dataset(name).shape else np.empty(0)
        if values.shape != (count,) or not np.all(np.isfinite(values)):
            raise ValueError(f"{self.path}: {name}: found {values.tolist()}, expected {count} finite numbers")
        return [float(value) for value in values]

    def _scalar(self, name: str) -> int:
        dataset = self._reader.dataset(name)
        if dataset.shape not in ((), (1,)) or dataset.dtype.kind not in "iu":
            raise ValueError(
                f"{self.path}: {name}: found {dataset.dtype} {dataset.shape}, expected one integer"
            )
        return int(np.asarray(dataset).reshape(()))
