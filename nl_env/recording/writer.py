"""Recording a sequence: the simulator's events, depth and state, written in whole chunks as they appear."""

from __future__ import annotations

import hashlib
import io
import math
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nl_env.config import DrivingConfig, choice
from nl_env.keyframes import label_keyframe
from nl_env.recording.schema import CHECKSUM, DEPTH_PERIODS_US, EVENT_FIELDS, LIBVER, Column, Header
from nl_env.runs import replacing
from nl_env.sensors.lidar import decode, encode
from nl_env.simulator import Simulator
from nl_env.types import SLICE_US, TICK_US, EgoState

BATCH_BYTES = 1 << 20

GZIP_LEVEL = 1
"""Higher levels save 5 % of the size and cost more time than the simulation has to spare."""


def record_sequence(
    path: str | Path,
    config: DrivingConfig,
    seed: int,
    depth_period_us: int = SLICE_US,
    *,
    intensity: bool = False,
) -> None:
    """Simulate the sequence of ``seed`` and write it to ``path``, whole or not at all.

    The bytes follow from the arguments alone (same machine, same versions).

    Args:
        path: the file; replaced if it exists.
        config: the generator's configuration.
        seed: sequence seed, a non-negative integer.
        depth_period_us: time between depth frames, 20 000, 10 000 or 5 000 us.
        intensity: also store an 8-bit picture per slice, for display (about a fifth more space).

    Raises:
        ValueError: a depth period that is not one of the three.
        OSError: the file cannot be written; the message names it.
    """
    choice("depth_period_us", depth_period_us, DEPTH_PERIODS_US)
    simulator = Simulator(config, seed)
    header = Header(seed, config, simulator.describe(), depth_period_us, intensity)
    try:
        with (
            replacing(Path(path)) as temporary,
            DeferredInterrupts() as interrupts,
            CheckedOutput(temporary) as output,
        ):
            with h5py.File(output, "w", libver=LIBVER) as file:
                datasets = {
                    name: DatasetWriter(file, name, column) for name, column in header.columns.items()
                }
                for _ in _record(simulator, header, datasets):
                    output.check()
                    interrupts.check()
                for dataset in datasets.values():
                    dataset.finish()
                header.write(file)
            output.check()
    except OSError as error:
        raise OSError(f"{path}: cannot write the recording ({error})") from error


class CheckedOutput(io.FileIO):
    """A file whose failures wait for :meth:`check`: HDF5 ends the process after a write that failed."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "wb+")
        self._error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write everything; once that has failed (a full disk), pretend."""
        view = memoryview(data).cast("B")
        done = 0
        while self._error is None and done < len(view):
            try:
                done += super().write(view[done:])
            except OSError as error:
                self._error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length, under the same rule."""
        if self._error is None:
            try:
                return super().truncate(size)
            except OSError as error:
                self._error = error
        return self.tell() if size is None else size

    def check(self) -> None:
        """Raise the ``OSError`` of the first write that failed."""
        if self._error is not None:
            raise self._error


class DeferredInterrupts:
    """Ctrl-C waits for :meth:`check`, because HDF5 calls back into Python, which must not raise there."""

    def __init__(self) -> None:
        self._pending = False
        self._previous: Callable[[int, Any], Any] | None = None

    def __enter__(self) -> DeferredInterrupts:
        previous = signal.getsignal(signal.SIGINT)
        if callable(previous) and threading.current_thread() is threading.main_thread():
            self._previous = previous
            signal.signal(signal.SIGINT, self._wait)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)
        if kind is None:
            self.check()

    def check(self) -> None:
        """Handle a Ctrl-C as it would have been: raise ``KeyboardInterrupt``, if nobody changed that."""
        if self._pending and self._previous is not None:
            self._pending = False
            self._previous(signal.SIGINT, None)

    def _wait(self, *_: object) -> None:
        self._pending = True


class DatasetWriter:
    """One dataset that grows by whole chunks, so that each is compressed once.

    Rows wait in memory for a batch of about ``BATCH_BYTES``, or one chunk where that is larger.
    """

    def __init__(self, file: h5py.File, name: str, column: Column) -> None:
        self._dtype = np.dtype(column.dtype)
        row_bytes = self._dtype.itemsize * math.prod(n for n in column.shape[1:] if n is not None)
        self._batch = max(BATCH_BYTES // row_bytes // column.chunk, 1) * column.chunk
        self._written = 0
        self._sha = hashlib.sha256()
        self._waiting: list[NDArray[Any]] = []
        self._rows_waiting = 0
        row = column.shape[1:]
        self._dataset = file.create_dataset(
            name,
            shape=(0, *row),
            dtype=self._dtype,
            maxshape=(None, *row),
            chunks=(column.chunk, *row),
            compression="gzip",
            compression_opts=GZIP_LEVEL,
            shuffle=True,
            fletcher32=True,
            track_times=False,
        )

    def append(self, rows: Any) -> None:
        """Add ``(n, ...)`` rows, converted to the dataset's type."""
        block = np.ascontiguousarray(rows, self._dtype)
        self._sha.update(block.data)
        self._waiting.append(block)
        self._rows_waiting += len(block)
        if self._rows_waiting >= self._batch:
            self._write(self._rows_waiting // self._batch * self._batch)

    def finish(self) -> None:
        """Write the rest and the checksum."""
        self._write(self._rows_waiting)
        self._dataset.attrs[CHECKSUM] = np.bytes_(self._sha.hexdigest())

    def _write(self, rows: int) -> None:
        if rows == 0:
            return
        block = np.concatenate(self._waiting)
        self._dataset.resize(self._written + rows, axis=0)
        self._dataset[self._written :] = block[:rows]
        self._written += rows
        self._waiting = [block[rows:]]
        self._rows_waiting -= rows


def _record(simulator: Simulator, header: Header, datasets: dict[str, DatasetWriter]) -> Iterator[None]:
    """Run the sequence into the datasets; yields after every tick."""
    max_depth = header.config.lidar.max_depth
    events = 0
    while True:
        t = simulator.t
        if t > 0:
            block = simulator.event_camera.events(simulator.intensity, t)
            events += len(block)
            for name in EVENT_FIELDS:
                datasets[f"events/{name}"].append(block[name])
        datasets["events/tick_index"].append([events])
        if t % SLICE_US == 0:
            datasets["events/slice_index"].append([events])
        if t % header.depth_period_us == 0:
            codes = encode(simulator.depth, max_depth)
            datasets["depth/codes"].append(codes[None])
            datasets["depth/t"].append([t])
            if t % SLICE_US == 0:
                state = simulator.state(decode(codes, max_depth))
                pose, twist = state.pose, state.twist
                _record_state(state, datasets)
            else:
                pose, twist = simulator.motion()
            datasets["depth/pose"].append(pose[None])
            datasets["depth/twist"].append(twist[None])
        if header.intensity and t % SLICE_US == 0:
            grey = np.rint(255 * np.clip(simulator.intensity, 0.0, 1.0))
            datasets["intensity/frames"].append(grey[None])
        yield
        if t == header.slices * SLICE_US:
            return
        simulator.tick(depth=(t + TICK_US) % header.depth_period_us == 0)


def _record_state(state: EgoState, datasets: dict[str, DatasetWriter]) -> None:
    label = label_keyframe(state)
    datasets["state/speed"].append([state.speed])
    datasets["state/shortest_distance"].append([state.shortest_distance])
    datasets["state/new_actors"].append([state.new_actors])
    datasets["state/keyframe_speed"].append([label.speed])
    datasets["state/keyframe_distance"].append([label.distance])
    datasets["state/keyframe_new"].append([label.new])
