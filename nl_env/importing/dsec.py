"""DSEC's disparity as depth, its calibration, and events at the pixels that both are for.

Disparity is given for the *rectified* left event camera, events as the sensor saw them; ``rectify_map.h5``
leads from one to the other.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.importing.ms_indexed import load_filters
from nl_env.importing.source import Calibration, EventSource, checked_times

DISPARITY_STEP = 1 / 256
"""Pixels a unit of the 16-bit pictures; 0 is no ground truth."""
TIMES_FILE = "timestamps.txt"
EVENTS_FOLDER, EVENTS_SUFFIX = "event", "_event"
RECTIFY_MAP = "rectify_map"
RECTIFIED_CAMERA, REPROJECTION = "camRect0", "cams_03"
"""In ``cam_to_cam.yaml``: the rectified left event camera, and from its disparity to depth."""


@dataclass(frozen=True)
class StereoCalibration:
    """What ``cam_to_cam.yaml`` says of the rectified left event camera.

    Attributes:
        path: the file.
        camera: its intrinsics.
        shape: ``(H, W)``.
        numerator, slope, offset: depth in m is ``numerator / (slope * disparity + offset)``.
    """

    path: Path
    camera: Calibration
    shape: tuple[int, int]
    numerator: float
    slope: float
    offset: float

    @classmethod
    def read(cls, path: str | Path) -> StereoCalibration:
        """Read ``cam_to_cam.yaml``.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not YAML, or without these numbers.
            ImportError: PyYAML is not installed.
        """
        path = Path(path)
        content = _read_yaml(path)
        width, height = _numbers(path, content, ("intrinsics", RECTIFIED_CAMERA, "resolution"), (2,))
        fx, fy, cx, cy = _numbers(path, content, ("intrinsics", RECTIFIED_CAMERA, "camera_matrix"), (4,))
        q = _numbers(path, content, ("disparity_to_depth", REPROJECTION), (4, 4))
        if min(width, height) < 1 or min(fx, fy) <= 0:
            raise ValueError(
                f"{path}: {RECTIFIED_CAMERA}: found {width:g}x{height:g} pixels, "
                f"focal lengths {fx} and {fy}, expected positive numbers"
            )
        # OpenCV's matrix takes (x, y, disparity, 1) to (X, Y, Z, W) with Z constant and W free of x and y.
        if q[2, :3].any() or q[3, :2].any() or q[2, 3] <= 0 or q[3, 2] <= 0:
            raise ValueError(
                f"{path}: disparity_to_depth.{REPROJECTION}: found {q.tolist()}, expected one that makes "
                "depth of disparity alone, less of more"
            )
        camera = Calibration((fx + fy) / 2, cx, cy)
        return cls(path, camera, (int(height), int(width)), q[2, 3], q[3, 2], q[3, 3])

    def depth(self, codes: NDArray[np.uint16]) -> NDArray[np.float32]:
        """``(H, W)`` float32 m of a 16-bit disparity picture; 0 where it has none."""
        w = self.slope * DISPARITY_STEP * codes.astype(np.float64) + self.offset
        found = (codes > 0) & (w > 0)
        return np.where(found, self.numerator / np.where(found, w, 1.0), 0.0).astype(np.float32)


class DisparityMaps:
    """DSEC's ``disparity`` folder as depth of the rectified left event camera.

    A :class:`nl_env.importing.DepthSource`; read picture by picture. Takes ``disparity`` (with
    ``event/*.png`` and ``timestamps.txt``), ``disparity/event``, or ``SEQUENCE_disparity_event`` (with
    ``SEQUENCE_disparity_timestamps.txt`` beside it).

    Args:
        folder: with the pictures.
        calibration: of the same sequence.

    Raises:
        FileNotFoundError: no such folder, or half of it.
        ValueError: as many times as pictures are expected, times that ascend.
    """

    def __init__(self, folder: str | Path, calibration: StereoCalibration) -> None:
        self.path = Path(folder)
        if not self.path.is_dir():
            raise FileNotFoundError(f"{self.path}: no such folder; expected DSEC's disparity")
        inner = self.path / EVENTS_FOLDER
        pictures = inner if inner.is_dir() else self.path
        self._pictures = sorted(pictures.glob("*.png"))
        if not self._pictures:
            raise FileNotFoundError(f"{pictures}: found no .png, expected DSEC's event disparity")
        times = _times_file(pictures)
        self.times: NDArray[np.int64] = checked_times(str(times), _read_integers(times))
        if len(self.times) != len(self._pictures):
            raise ValueError(
                f"{times}: found {len(self.times)} times, "
                f"expected {len(self._pictures)}, one for each picture in {pictures}"
            )
        self._calibration = calibration
        self.shape = calibration.shape

    def __len__(self) -> int:
        return len(self._pictures)

    def read(self, k: int) -> NDArray[np.float32]:
        """``(H, W)`` float32 m, picture ``k``; 0 where there is no ground truth.

        Raises:
            ValueError: no such picture, damage, or not 16 bits in the calibration's size.
        """
        if not 0 <= k < len(self):
            raise ValueError(f"{self.path}: found picture {k}, expected 0 to {len(self) - 1}")
        path = self._pictures[k]
        try:
            with Image.open(path) as picture:
                mode, size = picture.mode, picture.size
                codes = np.asarray(picture)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            raise ValueError(f"{path}: not a readable picture ({error})") from error
        if codes.ndim != 2 or mode not in ("I;16", "I;16B", "I") or size != self.shape[::-1]:
            raise ValueError(
                f"{path}: found {size[0]}x{size[1]} pixels of kind {mode}, "
                f"expected {self.shape[1]}x{self.shape[0]} of 16 bits, as {self._calibration.path} says"
            )
        return self._calibration.depth(codes.astype(np.uint16))

    def close(self) -> None:
        """Nothing stays open between calls."""


class RectifiedEvents:
    """Events at the pixels of the rectified camera; an :class:`nl_env.importing.EventSource`.

    Every event goes to the pixel nearest to where ``rectify_map.h5`` puts it; those off the picture are left
    out. Times and order stay.

    Args:
        source: events as the sensor saw them.
        path: ``rectify_map.h5`` of the same camera.
        camera: intrinsics of the rectified camera, where they are known.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no map, of another size than the sensor, or with numbers that are not finite.
    """

    def __init__(self, source: EventSource, path: str | Path, camera: Calibration | None = None) -> None:
        self._source = source
        self.path, self.shape, self.calibration = source.path, source.shape, camera
        self.layout = f"{source.layout}, rectified"
        load_filters()
        with Hdf5Reader(Path(path)) as reader:
            found = reader.dataset(RECTIFY_MAP)
            if found.shape != (*self.shape, 2):
                raise ValueError(
                    f"{path}: {RECTIFY_MAP}: found {found.shape}, "
                    f"expected {(*self.shape, 2)}, the sensor's size"
                )
            places = reader.read(RECTIFY_MAP, slice(None)).astype(np.float64)
        if not np.isfinite(places).all():
            raise ValueError(f"{path}: {RECTIFY_MAP}: found NaN or infinity, expected pixels")
        height, width = self.shape
        pixels = np.rint(places.clip(-1, max(self.shape))).astype(np.int64)
        self._x, self._y = pixels[..., 0], pixels[..., 1]
        self._inside = (self._x >= 0) & (self._x < width) & (self._y >= 0) & (self._y < height)

    def __len__(self) -> int:
        """Number of events that the sensor sent."""
        return len(self._source)

    def span(self) -> tuple[int, int]:
        """Times of the sensor's first and last event, us."""
        return self._source.span()

    def blocks(self, start_us: int, stop_us: int) -> Iterator[NDArray[np.void]]:
        """The rectified events of ``[start_us, stop_us)``; raises as the source."""
        for block in self._source.blocks(start_us, stop_us):
            x, y = block["x"], block["y"]
            inside = self._inside[y, x]
            events = block[inside]
            events["x"], events["y"] = self._x[y, x][inside], self._y[y, x][inside]
            yield events

    def verify(self) -> None:
        """Read everything; raises as the source."""
        self._source.verify()

    def close(self) -> None:
        """Release the source; may be called twice."""
        self._source.close()


def _times_file(pictures: Path) -> Path:
    """The times of a folder of pictures: in it, beside it, or with its name."""
    places = [pictures / TIMES_FILE, pictures.parent / TIMES_FILE]
    if pictures.name.endswith(EVENTS_SUFFIX):
        stem = pictures.name.removesuffix(EVENTS_SUFFIX)
        places.insert(0, pictures.with_name(f"{stem}_{TIMES_FILE}"))
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"{pictures}: found no times, expected {' or '.join(map(str, places))}")


def _read_integers(path: Path) -> NDArray[np.int64]:
    """One integer a line; raises ``ValueError`` with the line that is none."""
    try:
        lines = path.read_text(encoding="utf-8-sig").split()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: found bytes that are not text, expected one time in us a line") from error
    values = []
    for number, line in enumerate(lines, start=1):
        if not line.removeprefix("-").isdecimal() or len(line) > 18:
            raise ValueError(f"{path}: line {number}: found {line[:40]!r}, expected a time in us")
        values.append(int(line))
    return np.array(values, np.int64)


def _read_yaml(path: Path) -> Any:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; expected DSEC's cam_to_cam.yaml")
    try:
        yaml = importlib.import_module("yaml")
    except ImportError as error:
        raise ImportError(f"{path}: needs the package pyyaml (pip install 'nl-env[importing]')") from error
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not readable YAML ({error})") from error


def _numbers(path: Path, content: Any, keys: tuple[str, ...], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """The finite numbers of ``shape`` under ``keys``."""
    where = ".".join(keys)
    for key in keys:
        content = content.get(key) if isinstance(content, dict) else None
    try:
        values = np.array(content, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{path}: {where}: found {content!r:.200}, expected finite numbers, {shape}")
    return values
