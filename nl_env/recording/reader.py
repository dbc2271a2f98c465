"""Reading a recording: events, depth, poses and labels at any stored time, each read checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig
from nl_env.recording.file import RecordingFile, naming_damage
from nl_env.recording.schema import EVENT_FIELDS, Header
from nl_env.recording.sums import add_binned_events, add_events
from nl_env.representations import frame_from_bins, validate_events, voxel_grid
from nl_env.sensors.lidar import decode
from nl_env.types import BINS, EVENT_DTYPE, SLICE_US, TICK_US, TICKS_PER_SLICE, Camera, EgoState

_BIN_EDGES = np.arange(-BINS, 1, dtype=np.int64) * (SLICE_US // BINS)
"""First microsecond of each bin of a slice, and its end, counted from its end."""


class Recording:
    """One recorded sequence.

    The file is opened at the first access, once per process; copies sent to other processes carry the
    path only. Damage that reading meets raises ``ValueError`` with the file and what is wrong with it;
    :meth:`verify` reads everything.

    Args:
        path: a file written by :func:`nl_env.recording.record_sequence`.

    Raises:
        FileNotFoundError: at the first access, where there is no file.
        ValueError: at the first access, where it is not a recording of this schema version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file = RecordingFile(self.path)

    # Header

    @property
    def header(self) -> Header:
        """Everything that is not an array."""
        return self._file.header

    @property
    def seed(self) -> int:
        """Sequence seed."""
        return self.header.seed

    @property
    def config(self) -> DrivingConfig:
        """The generator's full configuration."""
        return self.header.config

    @property
    def camera(self) -> Camera:
        """Intrinsics of the event camera and the depth."""
        return self.header.config.camera

    @property
    def slices(self) -> int:
        """Index K of the last slice; the sequence lasts ``K * SLICE_US``."""
        return self.header.slices

    @property
    def lidar_period(self) -> int:
        """Slices between LiDAR frames."""
        return self.header.config.lidar.period

    @property
    def max_depth(self) -> float:
        """Sensor range, m."""
        return self.header.config.lidar.max_depth

    @property
    def description(self) -> dict[str, Any]:
        """Scenario, style, weather and seed."""
        return dict(self.header.description)

    @property
    def depth_period_us(self) -> int:
        """Time between stored depth frames and poses, us."""
        return self.header.depth_period_us

    # Events

    def events(self, t0_us: int, t1_us: int) -> NDArray[np.void]:
        """Events of ``[t0_us, t1_us)`` as an ``EVENT_DTYPE`` array, in the order the camera sent them."""
        duration = self.slices * SLICE_US
        if not 0 <= t0_us < t1_us <= duration:
            raise ValueError(
                f"{self.path}: found the window [{t0_us}, {t1_us}) us, expected one within [0, {duration})"
            )
        ticks = self._index("tick_index")
        first, last = int(ticks[t0_us // TICK_US]), int(ticks[-(-t1_us // TICK_US)])
        times = self._file.look("events/t", first, last)
        start, stop = (int(cut) for cut in np.searchsorted(times, (t0_us, t1_us)))
        events = np.empty(stop - start, EVENT_DTYPE)
        events["t"] = times[start:stop]
        for name in ("x", "y", "p"):
            events[name] = self._file.look(f"events/{name}", first + start, first + stop)
        return events

    def event_count(self, k: int) -> int:
        """Number of events in slice ``k``, ``[t_k - SLICE_US, t_k)``; 0 for slice 0."""
        self._check_slice(k)
        cuts = self._index("slice_index")
        return int(cuts[k] - cuts[k - 1]) if k else 0

    @property
    def event_counts(self) -> NDArray[np.int64]:
        """``(K+1,)`` int64, :meth:`event_count` of every slice."""
        return np.diff(self._index("slice_index"), prepend=0)

    def bins(self, k: int) -> NDArray[np.int16]:
        """``(5, H, W)`` int16, the signed sums of slice ``k`` in its five 4 ms bins; zeros for slice 0."""
        self._check_slice(k)
        bins = np.zeros((BINS, *self.camera.shape), np.int16)
        if k == 0:
            return bins
        t, x, y, p = (self._column(name, k) for name in ("t", "x", "y", "p"))
        if add_binned_events(t, x, y, p, _BIN_EDGES + k * SLICE_US, bins):
            return bins
        return self.voxel((k - 1) * SLICE_US, k * SLICE_US).astype(np.int16)  # which says what is wrong

    def event_frame(self, k: int) -> NDArray[np.int16]:
        """``(H, W)`` int16, the event frame (Eq. 1) of slice ``k``: the sum of :meth:`bins`, for less."""
        self._check_slice(k)
        frame = np.zeros(self.camera.shape, np.int16)
        if k == 0:
            return frame
        x, y, p = (self._column(name, k) for name in ("x", "y", "p"))
        if add_events(x, y, p, frame):
            return frame
        return frame_from_bins(self.bins(k))

    def voxel(self, t0_us: int, t1_us: int) -> NDArray[np.float32]:
        """``(5, H, W)`` float32, the voxel grid (Eq. 2) of ``[t0_us, t1_us)``."""
        events = self.events(t0_us, t1_us)
        with naming_damage(self.path, "events"):
            return voxel_grid(events, self.camera.shape, t0_us, t1_us)

    # Depth and motion, at multiples of ``depth_period_us``

    def depth(self, t_us: int) -> NDArray[np.float32]:
        """``(H, W)`` float32 m at ``t_us`` as a dense LiDAR measures it, 0 = no return."""
        frame = self._frame(t_us)
        return decode(self._file.look("depth/codes", frame, frame + 1)[0], self.max_depth)

    def depth_codes(self, t_us: int) -> NDArray[np.uint16]:
        """``(H, W)`` uint16, :meth:`depth` in steps of ``max_depth / 65535``."""
        frame = self._frame(t_us)
        return self._file.read("depth/codes", frame, frame + 1)[0]

    def pose(self, t_us: int) -> NDArray[np.float64]:
        """``(4, 4)`` float64, camera to world at ``t_us``."""
        return self._file.array("depth/pose")[self._frame(t_us)].copy()

    def twist(self, t_us: int) -> NDArray[np.float64]:
        """``(6,)`` float64, camera-frame linear (m/s), then angular velocity (rad/s) at ``t_us``."""
        return self._file.array("depth/twist")[self._frame(t_us)].copy()

    # State and labels of every slice, index 0 is ``t = 0``; read-only arrays

    @property
    def speed(self) -> NDArray[np.float64]:
        """``(K+1,)`` float64, ego speed, m/s."""
        return self._file.array("state/speed")

    @property
    def shortest_distance(self) -> NDArray[np.float64]:
        """``(K+1,)`` float64, m to the nearest surface of an actor; ``inf`` without one."""
        return self._file.array("state/shortest_distance")

    @property
    def new_actors(self) -> NDArray[np.int64]:
        """``(K+1,)`` int64, actors that entered the view during the slice."""
        return self._file.array("state/new_actors")

    @property
    def keyframe_speed(self) -> NDArray[np.bool_]:
        """``(K+1,)`` bool, first cause: the ego is fast."""
        return self._file.array("state/keyframe_speed")

    @property
    def keyframe_distance(self) -> NDArray[np.bool_]:
        """``(K+1,)`` bool, second cause: an actor is near."""
        return self._file.array("state/keyframe_distance")

    @property
    def keyframe_new(self) -> NDArray[np.bool_]:
        """``(K+1,)`` bool, third cause: an actor is new."""
        return self._file.array("state/keyframe_new")

    @property
    def keyframe(self) -> NDArray[np.bool_]:
        """``(K+1,)`` bool, the label: any cause."""
        return self.keyframe_speed | self.keyframe_distance | self.keyframe_new

    def state(self, k: int) -> EgoState:
        """Ego state at the end of slice ``k``."""
        self._check_slice(k)
        frame, array = k * (SLICE_US // self.depth_period_us), self._file.array
        return EgoState(
            pose=array("depth/pose")[frame].copy(),
            twist=array("depth/twist")[frame].copy(),
            speed=float(array("state/speed")[k]),
            shortest_distance=float(array("state/shortest_distance")[k]),
            new_actors=int(array("state/new_actors")[k]),
        )

    def intensity(self, k: int) -> NDArray[np.uint8]:
        """``(H, W)`` uint8, what a frame camera would see at the end of slice ``k``; for display.

        Raises:
            ValueError: the sequence was recorded without pictures.
        """
        self._check_slice(k)
        if not self.header.intensity:
            raise ValueError(
                f"{self.path}: holds no pictures; record it again with intensity=True (record.py --intensity)"
            )
        return self._file.read("intensity/frames", k, k + 1)[0]

    # Integrity

    def verify(self) -> None:
        """Read everything and compare it with its checksums and with itself.

        Raises:
            ValueError: the first damage, with file and dataset.
        """
        self._file.verify()
        ticks = self._index("tick_index")
        for name, expected in (
            ("events/slice_index", ticks[::TICKS_PER_SLICE]),
            ("depth/t", np.arange(self.header.depth_frames) * self.depth_period_us),
        ):
            if not np.array_equal(self._file.array(name), expected):
                raise ValueError(f"{self.path}: {name}: found values that contradict the time line")
        for tick in range(0, len(ticks) - 1, TICKS_PER_SLICE):
            edges = np.arange(tick, tick + TICKS_PER_SLICE + 1)
            events = self.events(edges[0] * TICK_US, edges[-1] * TICK_US)
            with naming_damage(self.path, "events"):
                validate_events(events, self.camera.shape)
            if not np.array_equal(ticks[tick] + np.searchsorted(events["t"], edges * TICK_US), ticks[edges]):
                raise ValueError(
                    f"{self.path}: events/tick_index: found other offsets than events/t has "
                    f"between {edges[0] * TICK_US} and {edges[-1] * TICK_US} us"
                )

    def close(self) -> None:
        """Close the file; may be called twice. The next access opens it again."""
        self._file.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Recording({str(self.path)!r})"

    def _index(self, name: str) -> NDArray[np.int64]:
        """Offsets into the events, checked: they ascend from 0 to the number of events."""
        return self._file.array(f"events/{name}", lambda index: self._check_index(name, index))

    def _column(self, name: str, k: int) -> NDArray[Any]:
        """One column of the events of slice ``k``, not to be written to."""
        cuts = self._index("slice_index")
        return self._file.look(f"events/{name}", int(cuts[k - 1]), int(cuts[k]))

    def _check_index(self, name: str, index: NDArray[np.int64]) -> None:
        lengths = {self._file.rows(f"events/{field}") for field in EVENT_FIELDS}
        if index[0] != 0 or lengths != {int(index[-1])} or np.any(index[1:] < index[:-1]):
            raise ValueError(
                f"{self.path}: events/{name}: found offsets from {index[0]} to {index[-1]}, "
                f"expected them to ascend from 0 to the number of events, {sorted(lengths)}"
            )

    def _frame(self, t_us: int) -> int:
        frame, rest = divmod(int(t_us), self.depth_period_us)
        if rest or not 0 <= frame < self.header.depth_frames:
            raise ValueError(
                f"{self.path}: t_us: found {t_us}, expected a multiple of {self.depth_period_us} "
                f"in [0, {self.slices * SLICE_US}], the times at which it holds depth"
            )
        return frame

    def _check_slice(self, k: int) -> None:
        if not 0 <= k <= self.slices:
            raise ValueError(f"{self.path}: slice: found {k}, expected 0 to {self.slices}")
