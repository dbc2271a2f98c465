"""What a recording holds: names, types and shapes of its datasets, and its header.

Every dataset is compressed in a way that plain h5py reads (shuffle, gzip), guarded chunk by chunk
(fletcher32), and carries the SHA-256 of its raw bytes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

import nl_env
from nl_env.config import DrivingConfig, choice, from_dict, to_dict
from nl_env.types import SLICE_US, TICK_US, TICKS_PER_SLICE

SCHEMA = "nl_env recording"
VERSION = 1
LIBVER = ("v110", "v110")
"""HDF5 1.10 and later read the files; its format guards the metadata with checksums, too."""

DEPTH_PERIODS_US = (TICK_US, 2 * TICK_US, SLICE_US)
"""Depth at every slice, or also between slices."""

CHECKSUM = "sha256"
"""Attribute of every dataset: hex digest of its values, little-endian, in C order."""

EVENT_FIELDS = {"t": "<u4", "x": "<u2", "y": "<u2", "p": "|i1"}
"""Datasets ``events/t`` (us since the start), ``x``, ``y``, ``p``, one value per event."""


@dataclass(frozen=True)
class Column:
    """One dataset.

    Attributes:
        dtype: numpy type string.
        shape: of the whole dataset; the first is None where the number of events decides.
        chunk: rows per compressed chunk.
    """

    dtype: str
    shape: tuple[int | None, ...]
    chunk: int


@dataclass(frozen=True)
class Header:
    """Everything about a recording that is not an array.

    Attributes:
        seed: sequence seed.
        config: the generator's full configuration.
        description: scenario, style, weather and seed, as the stream describes them.
        depth_period_us: time between depth frames.
        intensity: whether 8-bit pictures are stored.
        nl_env_version: version that recorded.
    """

    seed: int
    config: DrivingConfig
    description: dict[str, Any]
    depth_period_us: int = SLICE_US
    intensity: bool = False
    nl_env_version: str = nl_env.__version__

    def __post_init__(self) -> None:
        choice("depth_period_us", self.depth_period_us, DEPTH_PERIODS_US)

    @property
    def slices(self) -> int:
        """Index K of the last slice."""
        return self.config.scene.slices

    @property
    def depth_frames(self) -> int:
        """Number of depth frames, the one of ``t = 0`` included."""
        return self.slices * (SLICE_US // self.depth_period_us) + 1

    @property
    def columns(self) -> dict[str, Column]:
        """Every dataset of the file, by its path."""
        height, width = self.config.camera.shape
        slices, frames = self.slices + 1, self.depth_frames
        # One event per pixel: a few slices, so little to decompress for one and enough to compress well.
        columns = {
            f"events/{name}": Column(kind, (None,), height * width) for name, kind in EVENT_FIELDS.items()
        }
        columns["events/slice_index"] = Column("<i8", (slices,), 1024)
        columns["events/tick_index"] = Column("<i8", (self.slices * TICKS_PER_SLICE + 1,), 1024)
        columns["depth/codes"] = Column("<u2", (frames, height, width), 1)
        columns["depth/t"] = Column("<i8", (frames,), 1024)
        columns["depth/pose"] = Column("<f8", (frames, 4, 4), 256)
        columns["depth/twist"] = Column("<f8", (frames, 6), 256)
        columns["state/speed"] = Column("<f8", (slices,), 1024)
        columns["state/shortest_distance"] = Column("<f8", (slices,), 1024)
        columns["state/new_actors"] = Column("<i8", (slices,), 1024)
        for cause in ("speed", "distance", "new"):
            columns[f"state/keyframe_{cause}"] = Column("|b1", (slices,), 1024)
        if self.intensity:
            columns["intensity/frames"] = Column("|u1", (slices, height, width), 1)
        return columns

    def write(self, file: h5py.File) -> None:
        """Store as attributes of ``file``; the last one marks the schema."""
        camera = self.config.camera
        attributes = file.attrs
        for name in ("height", "width", "fx", "fy", "cx", "cy"):
            attributes[f"camera_{name}"] = getattr(camera, name)
        attributes["config"] = _text(json.dumps(to_dict(self.config), sort_keys=True))
        attributes["description"] = _text(json.dumps(self.description, sort_keys=True))
        attributes["seed"] = self.seed
        attributes["depth_period_us"] = self.depth_period_us
        attributes["intensity"] = self.intensity
        attributes["max_depth"] = self.config.lidar.max_depth
        attributes["nl_env_version"] = _text(self.nl_env_version)
        attributes["schema_version"] = VERSION
        attributes["schema"] = _text(SCHEMA)

    @classmethod
    def read(cls, file: h5py.File) -> Header:
        """Read back what :meth:`write` stored.

        Raises:
            ValueError: not a recording, another version, or attributes that are missing or contradict.
        """
        attributes = file.attrs
        schema = _string(attributes["schema"]) if "schema" in attributes else None
        if schema != SCHEMA:
            raise ValueError(f"schema: found {schema!r}, expected {SCHEMA!r}")
        version = int(_attribute(file, "schema_version"))
        if version != VERSION:
            raise ValueError(
                f"schema_version: found {version}, expected {VERSION}; record the sequence again "
                "or read it with the version that recorded it"
            )
        config = from_dict(DrivingConfig, _json(file, "config"))
        header = cls(
            seed=int(_attribute(file, "seed")),
            config=config,
            description=_json(file, "description"),
            depth_period_us=int(_attribute(file, "depth_period_us")),
            intensity=bool(_attribute(file, "intensity")),
            nl_env_version=_string(_attribute(file, "nl_env_version")),
        )
        for name in ("height", "width", "fx", "fy", "cx", "cy"):
            found, expected = float(_attribute(file, f"camera_{name}")), float(getattr(config.camera, name))
            if found != expected:
                raise ValueError(f"camera_{name}: found {found}, expected {expected} as its config says")
        return header

    def check(self, file: h5py.File) -> None:
        """Raise ``ValueError`` unless ``file`` has every dataset with the type and shape it must have."""
        for path, column in self.columns.items():
            dataset = file.get(path)
            if not isinstance(dataset, h5py.Dataset):
                raise ValueError(f"{path}: found {dataset!r}, expected a dataset")
            if dataset.dtype != np.dtype(column.dtype):
                raise ValueError(f"{path}: found {dataset.dtype}, expected {np.dtype(column.dtype)}")
            shape = tuple(
                found if expected is None else expected
                for found, expected in zip(dataset.shape, column.shape, strict=False)
            )
            if dataset.ndim != len(column.shape) or dataset.shape != shape:
                raise ValueError(f"{path}: found shape {dataset.shape}, expected {column.shape}")


def _text(value: str) -> np.bytes_:
    """Text of fixed length lies in the object header, which has a checksum; h5py reads it as bytes."""
    return np.bytes_(value.encode("utf-8"))


def _string(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _attribute(file: h5py.File, name: str) -> Any:
    if name not in file.attrs:
        raise ValueError(f"attribute {name}: found none")
    return file.attrs[name]


def _json(file: h5py.File, name: str) -> dict[str, Any]:
    value = json.loads(_string(_attribute(file, name)))
    if not isinstance(value, dict):
        raise ValueError(f"attribute {name}: found {type(value).__name__}, expected a JSON object")
    return value
