"""What every event file gives: its sensor, its span, and checked events in order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nl_env.types import EVENT_DTYPE


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of an event camera, in pixels of the sensor; lens distortion is left out.

    Attributes:
        focal: mean of the two focal lengths.
        cx, cy: principal point.
    """

    focal: float
    cx: float
    cy: float


class EventSource(Protocol):
    """One camera's events in a file.

    Attributes:
        path: the file.
        layout: what kind of file it is, in a word.
        shape: ``(H, W)`` of the sensor.
        calibration: intrinsics where the file has them.
    """

    path: Path
    layout: str
    shape: tuple[int, int]
    calibration: Calibration | None

    def __len__(self) -> int:
        """Number of events."""
        ...

    def span(self) -> tuple[int, int]:
        """Times of the first and of the last event, us on the file's clock."""
        ...

    def blocks(self, start_us: int, stop_us: int) -> Iterator[NDArray[np.void]]:
        """Events of ``[start_us, stop_us)`` in order, as ``EVENT_DTYPE`` arrays of any length.

        Raises:
            ValueError: damage, with the file and what is wrong with it.
        """
        ...

    def verify(self) -> None:
        """Read everything; raises ``ValueError`` with the first damage."""
        ...

    def close(self) -> None:
        """Release the file; may be called twice."""
        ...


class DepthSource(Protocol):
    """Depth maps of the event camera, with times.

    Attributes:
        path: the file or folder.
        shape: ``(H, W)``, that of the events.
        times: ``(N,)`` int64, us on the events' clock, ascending.
    """

    path: Path
    shape: tuple[int, int]
    times: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of maps."""
        ...

    def read(self, k: int) -> NDArray[np.float32]:
        """``(H, W)`` float32 m along the optical axis, map ``k``; 0 = no return.

        Raises:
            ValueError: damage, with the file and what is wrong with it.
        """
        ...

    def close(self) -> None:
        """Release the file; may be called twice."""
        ...


def checked_times(where: str, values: NDArray[Any]) -> NDArray[np.int64]:
    """``(N,)`` times as int64 us; fractions of one are rounded, as M3ED stores them.

    Args:
        where: file and dataset that messages name.
        values: integers or floats.

    Raises:
        ValueError: none, another rank or type, not finite, negative, or not ascending.
    """
    if values.ndim != 1 or len(values) == 0 or values.dtype.kind not in "iuf":
        raise ValueError(f"{where}: found {values.dtype} {values.shape}, expected times in us, at least one")
    wrong = ~np.isfinite(values) | (values < 0) | (values >= 2.0**62)
    if not wrong.any():
        times = np.rint(values).astype(np.int64) if values.dtype.kind == "f" else values.astype(np.int64)
        wrong = np.diff(times, prepend=-1) <= 0
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(
            f"{where}[{k}]: found {values[k]} us, expected times that ascend from 0 without repeating"
        )
    return times


class EventChecker:
    """Turns raw columns into ``EVENT_DTYPE``, one block after the other, and refuses what cannot be events.

    Args:
        where: file (and group) that messages name.
        shape: ``(H, W)`` of the sensor.
    """

    def __init__(self, where: str, shape: tuple[int, int]) -> None:
        self._where = where
        self._shape = shape
        self._last: int | None = None

    def __call__(
        self, first: int, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]
    ) -> NDArray[np.void]:
        """Check one block.

        Args:
            first: number of its first event in the file, for messages.
            t, x, y: times in us, columns and rows, integers.
            p: polarity, 0 or 1, or -1 and 1.

        Raises:
            ValueError: times that are negative or go backwards, pixels off the sensor, other polarities.
        """
        events = np.empty(len(t), EVENT_DTYPE)
        if len(t) == 0:
            return events
        times = t.astype(np.int64)
        before = times[0] if self._last is None else self._last
        steps = np.diff(times, prepend=before)
        self._refuse(first, times < 0, times, "t", "a time of at least 0")
        self._refuse(first, steps < 0, times, "t", "no time before that of the previous event")
        height, width = self._shape
        self._refuse(first, (x < 0) | (x >= width), x, "x", f"0 to {width - 1}")
        self._refuse(first, (y < 0) | (y >= height), y, "y", f"0 to {height - 1}")
        polarity = p.astype(np.int8)
        allowed = (-1, 1) if np.any(polarity < 0) else (0, 1)
        self._refuse(first, ~np.isin(polarity, allowed), p, "p", f"{allowed[0]} or {allowed[1]}")
        self._last = int(times[-1])
        events["t"], events["x"], events["y"] = times, x, y
        events["p"] = np.where(polarity > 0, 1, -1)
        return events

    def _refuse(
        self, first: int, wrong: NDArray[np.bool_], values: NDArray[Any], name: str, expected: str
    ) -> None:
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(
                f"{self._where}: found {name} = {int(values[k])} at event {first + k}, expected {expected}"
            )


def between(events: NDArray[np.void], start_us: int, stop_us: int) -> NDArray[np.void]:
    """The events of ``[start_us, stop_us)`` among sorted ones."""
    first, last = np.searchsorted(events["t"], (start_us, stop_us))
    return events[first:last]
