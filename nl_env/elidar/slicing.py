"""The keyframe release: labelled event frames in one HDF5, and whole sequences as ``.npz``."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from nl_env.config import choice
from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.elidar.layout import RAW_ARRAYS, SPLITS
from nl_env.elidar.metadata import ON_ERROR, Problem
from nl_env.keyframes import DISTANCE_LIMIT, SPEED_LIMIT

INT16 = np.iinfo(np.int16)
UNREADABLE = (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading a damaged member of an archive may raise."""


class EventFrames:
    """Event frames that are read when a slice of them is asked for: ``frames[a:b]`` is ``(n, H, W)`` int8.

    Args:
        read: gives the frame ``(H, W)`` of an index.
        chosen: ``(n,)`` the indices, in the order wanted.
        shape: ``(H, W)``.
        lowest: counts are cut to ``[lowest, 127]``.
    """

    def __init__(
        self,
        read: Callable[[int], NDArray[Any]],
        chosen: NDArray[np.int64],
        shape: tuple[int, int],
        lowest: int = -128,
    ) -> None:
        self._read, self._chosen, self._shape, self._lowest = read, chosen, shape, lowest

    def __len__(self) -> int:
        return len(self._chosen)

    def __getitem__(self, window: slice) -> NDArray[np.int8]:
        chosen = self._chosen[window]
        frames = np.empty((len(chosen), *self._shape), np.int8)
        for frame, index in zip(frames, chosen.tolist(), strict=True):
            frame[...] = np.clip(self._read(index), self._lowest, 127)
        return frames


class SlicingData:
    """Labelled event frames of one split, ``{split}/event_frames`` and ``{split}/scores``.

    ``len`` and indexing give ``(event_frame, score)``: ``(H, W)`` float32 signed sums and 0.0 or 1.0.
    Reads frame by frame; pickles as its path.

    Args:
        hdf5: the file.
        split: ``"train"`` or ``"test"``.

    Attributes:
        shape: ``(H, W)``.
        scores: ``(N,)`` float32 labels.

    Raises:
        FileNotFoundError: no such file.
        ValueError: missing or misshapen datasets, or labels outside [0, 1].
    """

    def __init__(self, hdf5: Path, split: str) -> None:
        choice("split", split, SPLITS)
        self.split = split
        self._reader = Hdf5Reader(hdf5)
        frames = self._reader.dataset(f"{split}/event_frames")
        scores = self._reader.dataset(f"{split}/scores")
        if frames.ndim not in (3, 4) or (frames.ndim == 4 and frames.shape[1] != 1):
            raise ValueError(f"{hdf5}: {frames.name}: found shape {frames.shape}, expected (N, H, W)")
        if scores.shape not in ((len(frames),), (len(frames), 1)):
            raise ValueError(f"{hdf5}: {scores.name}: found shape {scores.shape}, expected ({len(frames)},)")
        self.shape = (int(frames.shape[-2]), int(frames.shape[-1]))
        self.scores = self._reader.read(f"{split}/scores", slice(None)).astype(np.float32).reshape(-1)
        wrong = np.flatnonzero(~((self.scores >= 0) & (self.scores <= 1)))
        if wrong.size:
            value = self.scores[wrong[0]]
            raise ValueError(f"{hdf5}: {scores.name}[{wrong[0]}]: found {value}, expected a label in [0, 1]")

    def __len__(self) -> int:
        return len(self.scores)

    def __getitem__(self, index: int) -> tuple[NDArray[np.float32], float]:
        if not 0 <= index < len(self):
            raise IndexError(f"event frame: found {index}, expected 0 to {len(self) - 1}")
        name = f"{self.split}/event_frames"
        frame = self._reader.read(name, int(index)).astype(np.float32).reshape(self.shape)
        if not np.isfinite(frame).all():
            raise ValueError(f"{self.path}: {name}[{index}]: found NaN or infinity, expected event counts")
        return frame, float(self.scores[index])

    def frames(self, chosen: NDArray[np.int64] | None = None, lowest: int = -128) -> EventFrames:
        """The event frames ``chosen``, or all, to be read block by block."""
        if chosen is None:
            chosen = np.arange(len(self))
        return EventFrames(lambda index: self[index][0], chosen, self.shape, lowest)

    @property
    def path(self) -> Path:
        """The HDF5 file."""
        return self._reader.path

    def close(self) -> None:
        """Close the file; it opens again when it is needed."""
        self._reader.close()


class RawSequence:
    """One sequence of the raw keyframe data: an ``.npz`` with an event frame, label and ego state a slice.

    The small arrays are read at once, event frames one by one; reading them in order is fast, going back
    starts the file again when it is compressed. Nothing is ever unpickled.

    Args:
        path: the file.

    Attributes:
        shape: ``(H, W)``.
        keyframe: ``(N,)`` bool.
        ego_speed: ``(N,)`` float64, m/s.
        shortest_distance: ``(N,)`` float64, m; ``inf`` where there is no other actor.
        new_actors: ``(N,)`` int64.

    Raises:
        FileNotFoundError: no such file.
        ValueError: truncated, an array missing, of another length, with objects, or with impossible values.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._archive: zipfile.ZipFile | None = None
        self._member: IO[bytes] | None = None
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such file; expected a raw ELiDAR sequence (.npz)")
        shape, self._dtype = self._open_frames()
        if len(shape) == 4 and shape[1] == 1:
            shape = (shape[0], *shape[2:])
        if len(shape) != 3:
            raise ValueError(f"{self.path}: frames: found shape {shape}, expected (N, H, W)")
        self._length, self.shape = shape[0], (shape[1], shape[2])
        self.keyframe = self._small("key_frame", 0, 1).astype(bool)
        self.ego_speed = np.abs(self._small("ego_velocity", -np.inf, np.inf))  # driving backwards is motion
        self.shortest_distance = self._small("shortest_distance", 0, np.inf, infinite=True)
        self.new_actors = self._small("num_new_actors", 0, 2**31).astype(np.int64)

    def __len__(self) -> int:
        return self._length

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_archive": None, "_member": None}

    @property
    def causes(self) -> NDArray[np.bool_]:
        """``(N, 3)``, the causes of the label: speed, distance, new.

        ``(N, 1)``, the label alone, where it does not follow from them by the paper's rule.
        """
        causes = np.stack(
            [self.ego_speed > SPEED_LIMIT, self.shortest_distance < DISTANCE_LIMIT, self.new_actors > 0],
            axis=1,
        )
        return causes if np.array_equal(causes.any(axis=1), self.keyframe) else self.keyframe[:, None]

    def frames(self) -> EventFrames:
        """All event frames, to be read block by block."""
        return EventFrames(self.frame, np.arange(len(self)), self.shape)

    def frame(self, index: int) -> NDArray[np.int16]:
        """Event frame of slice ``index``: ``(H, W)`` int16.

        Raises:
            ValueError: no such slice, damaged data, or values that are not whole numbers of events.
        """
        if not 0 <= index < self._length:
            raise ValueError(f"{self.path}: frames: found index {index}, expected 0 to {self._length - 1}")
        if self._member is None:
            self._open_frames()
        member = self._member
        assert member is not None
        size = self.shape[0] * self.shape[1] * self._dtype.itemsize
        try:
            member.seek(self._start + index * size)
            content = member.read(size)
        except UNREADABLE as error:
            raise ValueError(f"{self.path}: frames[{index}]: damaged or truncated ({error})") from error
        if len(content) != size:
            raise ValueError(f"{self.path}: frames[{index}]: found {len(content)} bytes, expected {size}")
        values = np.frombuffer(content, self._dtype).reshape(self.shape)
        with np.errstate(invalid="ignore"):  # NaN is found by the comparison
            frame = values.astype(np.int16)
        if not np.array_equal(frame, values):
            raise ValueError(
                f"{self.path}: frames[{index}]: found values from {values.min()} to {values.max()}, "
                f"expected whole numbers from {INT16.min} to {INT16.max}"
            )
        return frame

    def close(self) -> None:
        """Close the file; it opens again when it is needed."""
        if self._member is not None:
            self._member.close()
        if self._archive is not None:
            self._archive.close()
        self._member = self._archive = None

    def _open_frames(self) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Open the archive at the event frames and return their shape and dtype."""
        try:
            self._archive = zipfile.ZipFile(self.path)
        except (zipfile.BadZipFile, OSError) as error:
            raise ValueError(f"{self.path}: not a readable .npz ({error}), perhaps truncated") from error
        missing = [name for name in RAW_ARRAYS if f"{name}.npy" not in self._archive.namelist()]
        if missing:
            raise ValueError(f"{self.path}: found no {', '.join(missing)}; expected {', '.join(RAW_ARRAYS)}")
        self._member = self._archive.open("frames.npy")
        shape, dtype = _npy_header(self.path, self._member)
        self._start = self._member.tell()
        return shape, dtype

    def _small(self, name: str, low: float, high: float, *, infinite: bool = False) -> NDArray[np.float64]:
        """Array ``name`` as ``(N,)`` float64 with values in ``[low, high]``."""
        assert self._archive is not None
        try:
            with self._archive.open(f"{name}.npy") as file:
                array = np.lib.format.read_array(file, allow_pickle=False)
        except UNREADABLE as error:
            raise ValueError(f"{self.path}: {name}: cannot be read ({error})") from error
        if array.size != self._length or array.dtype.kind not in "iufb":
            raise ValueError(
                f"{self.path}: {name}: found {array.dtype} {array.shape}, expected {self._length} numbers"
            )
        values = array.reshape(-1).astype(np.float64)
        fine = (values >= low) & (values <= high) & (infinite | np.isfinite(values))
        if not fine.all():
            k = int(np.argmin(fine))
            raise ValueError(
                f"{self.path}: {name}[{k}]: found {values[k]}, expected a number in [{low}, {high}]"
            )
        return values


def readable_sequences(
    files: Mapping[str, Path], *, on_error: str = "raise"
) -> tuple[dict[str, Path], tuple[Problem, ...]]:
    """The raw sequences that can be opened, and the others.

    Event frames are not read: damage in them is found when they are.

    Args:
        files: of each sequence.
        on_error: ``"skip"`` leaves out what :class:`RawSequence` refuses.

    Raises:
        FileNotFoundError, ValueError: as :class:`RawSequence`, with ``on_error="raise"``.
    """
    choice("on_error", on_error, ON_ERROR)
    readable, problems = {}, []
    for name, path in files.items():
        try:
            RawSequence(path).close()
        except (FileNotFoundError, ValueError) as error:
            if on_error == "raise":
                raise
            problems.append(Problem(name, str(error)))
        else:
            readable[name] = path
    return readable, tuple(problems)


def _npy_header(path: Path, file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype of an ``.npy`` stream, which is left at the first value."""
    try:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, column_major, dtype = read(file)
    except UNREADABLE as error:
        raise ValueError(f"{path}: frames: cannot be read ({error})") from error
    if dtype.kind not in "iufb" or column_major:
        what = "column-major" if column_major else str(dtype)
        raise ValueError(f"{path}: frames: found a {what} array, expected row-major numbers")
    return shape, dtype
