"""Stored traces: what every trigger policy sees and is judged by on a recording, one file per sequence.

A file is in safetensors format: images and tables by name, and a JSON header that says what they were
computed from. Images are mapped, not read. A file of another recording, extrapolator or LiDAR is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.depth.metrics import METRIC_NAMES
from nl_env.runs import replacing
from nl_env.trace_source import TraceSource
from nl_env.traces import SequenceTrace

SCHEMA = "nl_env trace"
VERSION = 1
SUFFIX = ".safetensors"
SEQUENCES = "sequences"
"""Folder of the traces inside the folder that ``scripts/precompute.py`` writes."""

COLUMNS = {
    "event_count": np.dtype(np.int64),
    "active_fraction": np.dtype(np.float64),
    "ego_speed": np.dtype(np.float64),
    "shortest_distance": np.dtype(np.float64),
    "new_actors": np.dtype(np.int64),
    "keyframe": np.dtype(np.bool_),
    "keyframe_speed": np.dtype(np.bool_),
    "keyframe_distance": np.dtype(np.bool_),
    "keyframe_new": np.dtype(np.bool_),
    "lidar": np.dtype(np.bool_),
}
"""One value per slice each."""

_TYPES = {
    "I64": np.dtype("<i8"),
    "F64": np.dtype("<f8"),
    "BOOL": np.dtype(np.bool_),
    "U8": np.dtype(np.uint8),
}
_LONGEST_HEADER = 1 << 20


def default_folder(data: Path, extrapolator: str | os.PathLike[str], odometry: bool = False) -> Path:
    """Where the traces of ``data`` lie unless told otherwise: ``DATA-tables-EXTRAPOLATOR``, beside it."""
    name = Path(os.fspath(extrapolator)).stem + ("-odometry" if odometry else "")
    data = data.with_suffix("") if data.is_file() else data.resolve()
    return data.with_name(f"{data.name}-tables-{name}")


def write_trace(path: Path, trace: SequenceTrace, source: TraceSource) -> None:
    """Write ``trace`` to ``path``, whole or not at all. Same trace and source, same bytes.

    Small frames for a player are not stored.
    """
    from safetensors.numpy import save_file

    arrays = {
        "images": trace.images,
        **{name: getattr(trace, name) for name in COLUMNS},
        **{f"errors/{name}": trace.errors[name] for name in METRIC_NAMES},
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    header = {
        "schema": SCHEMA,
        "version": VERSION,
        "source": asdict(source),
        "seed": trace.seed,
        "description": trace.description,
        "lidar_period": trace.lidar_period,
        "sha256": {name: _array_digest(array) for name, array in arrays.items()},
    }
    # One entry, because several are stored in no fixed order.
    metadata = {SCHEMA: json.dumps(header, sort_keys=True)}
    with replacing(path) as temporary:
        save_file(arrays, temporary, metadata)


def open_trace(path: Path, expected: TraceSource | None = None) -> SequenceTrace:
    """Open a stored trace. Images stay in the file until they are looked at, everything else is read.

    Args:
        path: a file that :func:`write_trace` wrote.
        expected: refuse a trace of anything else.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no trace of this version, damaged, or computed from something else.
    """
    header, tensors, start = _read_header(path)
    if expected is not None:
        expected.check(TraceSource(**header["source"]), path)
    slices, period = tensors["lidar"].shape[0], header["lidar_period"]
    images = tensors["images"]
    if len(images.shape) != 3:
        raise ValueError(f"{path}: images: found shape {images.shape}, expected (K+1, H, W)")
    wanted = {
        "images": (np.dtype(np.uint8), (slices, *images.shape[1:])),
        **{name: (dtype, (slices,)) for name, dtype in COLUMNS.items()},
        **{f"errors/{name}": (np.dtype(np.float64), (slices, period)) for name in METRIC_NAMES},
    }
    arrays = {}
    mapped = np.memmap(path, np.uint8, "r").view(np.ndarray)
    for name, (dtype, shape) in wanted.items():
        tensor = tensors[name]
        if tensor.dtype != dtype or tensor.shape != shape:
            raise ValueError(f"{path}: {name}: found {tensor.dtype} {tensor.shape}, expected {dtype} {shape}")
        array = mapped[start + tensor.first : start + tensor.last].view(dtype).reshape(shape)
        if name != "images":
            array = array.copy()
            _check_digest(path, name, array, header)
            array.flags.writeable = False
        arrays[name] = array
    columns: dict[str, Any] = {name: arrays[name] for name in COLUMNS}
    return SequenceTrace(
        seed=header["seed"],
        description=header["description"],
        lidar_period=period,
        images=arrays["images"],
        **columns,
        errors={name: arrays[f"errors/{name}"] for name in METRIC_NAMES},
    )


def verify_trace(path: Path, expected: TraceSource | None = None) -> None:
    """Read all of a stored trace, the images as well, and compare it with its checksums.

    Raises:
        ValueError: as :func:`open_trace`, or the images are damaged.
    """
    trace = open_trace(path, expected)
    _check_digest(path, "images", trace.images, _read_header(path)[0])


def read_source(path: Path) -> TraceSource:
    """What the trace at ``path`` was computed from; raises as :func:`open_trace`."""
    return TraceSource(**_read_header(path)[0]["source"])


def trace_files(folder: Path) -> dict[int, Path]:
    """The stored traces of a folder by ascending seed.

    Raises:
        FileNotFoundError: no such folder, or no traces in it.
    """
    inner = folder / SEQUENCES if (folder / SEQUENCES).is_dir() else folder
    paths = [path for path in inner.glob(f"*{SUFFIX}") if path.stem.isdecimal()]
    if not paths:
        raise FileNotFoundError(
            f"tables: found no SEED{SUFFIX} in {inner}; make them with scripts/precompute.py"
        )
    return {int(path.stem): path for path in sorted(paths, key=lambda path: int(path.stem))}


def open_traces(folder: Path, seeds: Iterable[int] | None = None) -> dict[int, SequenceTrace]:
    """Open the stored traces of ``folder`` (of ``seeds``, in their order) by seed.

    Raises:
        FileNotFoundError: no such folder, no traces in it, or a seed without one.
        ValueError: as :func:`open_trace`, or traces of different extrapolators or LiDARs in one folder.
    """
    files = trace_files(folder)
    wanted = list(files) if seeds is None else list(seeds)
    missing = [seed for seed in wanted if seed not in files]
    if missing:
        raise FileNotFoundError(
            f"tables: found none of {len(missing)} sequences (such as {missing[0]}) in {folder}"
        )
    settings = {seed: {**asdict(read_source(files[seed])), "recording": ""} for seed in wanted}
    for seed in wanted[1:]:
        if settings[seed] != settings[wanted[0]]:
            raise ValueError(
                f"{files[seed]}: found a trace of {settings[seed]}, "
                f"expected {settings[wanted[0]]} as {files[wanted[0]].name} has"
            )
    traces = {seed: open_trace(files[seed]) for seed in wanted}
    for seed, trace in traces.items():
        if trace.seed != seed:
            raise ValueError(f"{files[seed]}: found the trace of seed {trace.seed}, expected {seed}")
    return traces


@dataclass(frozen=True)
class _Tensor:
    """Where one array lies in the data of a safetensors file."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    first: int
    last: int


def _read_header(path: Path) -> tuple[dict[str, Any], dict[str, _Tensor], int]:
    """Header of a trace, its arrays, and the offset of their data; checked against the file's length."""
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if not 2 <= length <= min(_LONGEST_HEADER, size - 8):
            raise ValueError(f"{path}: found no safetensors header, expected a stored trace")
        raw = file.read(length)
    try:
        entries = json.loads(raw)
        header = json.loads(entries.pop("__metadata__")[SCHEMA])
        tensors = {name: _parse_tensor(entry) for name, entry in entries.items()}
        version = header["version"]
        header |= {"seed": int(header["seed"]), "lidar_period": int(header["lidar_period"])}
        header |= {name: dict(header[name]) for name in ("source", "description", "sha256")}
        known = {entry.name for entry in fields(TraceSource)}
    except (ValueError, KeyError, TypeError, AttributeError) as cause:
        raise ValueError(
            f"{path}: found a header that is not a trace's ({cause!r}), expected a stored trace"
        ) from cause
    if version != VERSION:
        raise ValueError(f"{path}: found version {version}, expected {VERSION}; precompute it again")
    names = {"images", *COLUMNS, *(f"errors/{name}" for name in METRIC_NAMES)}
    if tensors.keys() != names or header["source"].keys() != known:
        raise ValueError(
            f"{path}: found the arrays {sorted(tensors)} of {header['source']}, expected {sorted(names)}"
        )
    end = 8 + length + max(tensor.last for tensor in tensors.values())
    if end != size:
        raise ValueError(f"{path}: found {size} bytes, expected {end}; precompute it again")
    return header, tensors, 8 + length


def _parse_tensor(entry: Mapping[str, Any]) -> _Tensor:
    dtype, shape = _TYPES[entry["dtype"]], tuple(int(length) for length in entry["shape"])
    first, last = (int(offset) for offset in entry["data_offsets"])
    if min(shape) < 0 or not 0 <= first <= last or last - first != dtype.itemsize * int(np.prod(shape)):
        raise ValueError(f"bytes {first} to {last} for {dtype} {shape}")
    return _Tensor(dtype, shape, first, last)


def _array_digest(array: NDArray[Any]) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()


def _check_digest(path: Path, name: str, array: NDArray[Any], header: Mapping[str, Any]) -> None:
    found, expected = _array_digest(array), header["sha256"].get(name)
    if found != expected:
        raise ValueError(f"{path}: {name}: found SHA-256 {found}, expected {expected}; precompute it again")
