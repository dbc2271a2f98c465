"""Names, places and number conventions of the ELiDAR release, and finding its files in a folder."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import h5py

from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.recording.manifest import MANIFEST
from nl_env.recording.schema import SCHEMA
from nl_env.types import TICK_US

PAIRS_FILE = Path("extrapolation/variable_interval_voxel_grids_v1.h5")
METADATA_FILE = Path("extrapolation/variable_interval_voxel_grids_v1_metadata.csv")
SLICING_FILE = Path("slicing/slicing_dataset_v1.h5")
SEQUENCE_LISTS = {
    "train": Path("slicing/train_sequences.txt"),
    "test": Path("slicing/test_sequences.txt"),
}
RAW_FOLDER = Path("raw_data/keyframe_detection")
"""Where the authors' scripts look, relative to their ``data`` folder."""

METADATA_COLUMNS = (
    "split",
    "sequence",
    "events_id",
    "prior_depth_frame_id",
    "gt_depth_frame_id",
    "duration",
)
RAW_ARRAYS = ("frames", "key_frame", "ego_velocity", "shortest_distance", "num_new_actors")

DURATIONS = (4, 10, 20, 40, 100)
"""Gaps between two depth frames in the released pairs, ticks of 5 ms: 50, 20, 10, 5 and 2 Hz."""
RANGE = 200.0
"""Depths beyond are no return, m. The indoor segment's range is 9 m."""
FAR_PLANE = 1000.0
"""What CARLA's depth camera gives where it sees nothing, m."""
SHAPE = (480, 640)
"""``(H, W)`` of the release."""

SPLITS = ("train", "test")

HDF5_SUFFIXES = (".h5", ".hdf5")
SEARCH_DEPTH = 4
"""Folders below the one given that are searched for files."""


def tick_us(tick: int) -> int:
    """Time of a tick, us."""
    return int(tick) * TICK_US


@dataclass(frozen=True)
class SequenceName:
    """What an ELiDAR sequence name says: ``Town05_Opt_ClearNoon`` or ``Town05_Opt_03``.

    Attributes:
        town: CARLA map.
        weather: preset, or None for a numbered sequence.
        number: number, or None for a sequence named by its weather.
    """

    town: str
    weather: str | None
    number: int | None

    @property
    def weather_group(self) -> str | None:
        """``Clear``, ``Cloudy``, ``Wet``, ``WetCloudy`` or ``Rain``, as the released tables group them."""
        if self.weather is None:
            return None
        sky = self.weather.removesuffix("Noon").removesuffix("Sunset")
        return "Rain" if sky.endswith(("Rain", "Rainy")) else sky


def parse_sequence_name(name: str) -> SequenceName:
    """Read a sequence name; raises ``ValueError`` unless it is ``TOWN_Opt_WEATHER`` or ``TOWN_Opt_NN``."""
    match = re.fullmatch(r"([A-Za-z0-9]+)_Opt_(?:([A-Za-z]+)|([0-9]+))", name)
    if match is None:
        raise ValueError(
            f"sequence: found {name!r}, expected a name like Town05_Opt_ClearNoon or Town05_Opt_03"
        )
    town, weather, number = match.groups()
    return SequenceName(town, weather, None if number is None else int(number))


def read_sequence_list(path: Path) -> tuple[str, ...]:
    """Sequence names of a list file, one per line.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not text, an empty list, or a name that occurs twice.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: found bytes that are not text, expected one sequence name a line"
        ) from error
    names = tuple(line.strip() for line in lines if line.strip())
    if not names:
        raise ValueError(f"{path}: found no sequence name, expected one a line")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{path}: found {', '.join(twice)} more than once, expected distinct sequence names")
    return names


@dataclass(frozen=True)
class ElidarFiles:
    """Which of ELiDAR's files a folder holds; None or empty where a part is missing.

    Attributes:
        folder: where they were looked for.
        pairs: extrapolation HDF5 (depth frames and voxel grids).
        metadata: its CSV.
        slicing: keyframe HDF5 (event frames and labels).
        raw: per-sequence ``.npz`` by sequence name.
        lists: the slicing release's sequence lists by split.
        unreadable: why HDF5 files that may be missing parts cannot be read.
    """

    folder: Path
    pairs: Path | None = None
    metadata: Path | None = None
    slicing: Path | None = None
    raw: Mapping[str, Path] = field(default_factory=dict)
    lists: Mapping[str, Path] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()

    def require_pairs(self) -> tuple[Path, Path]:
        """The extrapolation HDF5 and its CSV.

        Raises:
            FileNotFoundError: one is missing; the message says which.
            ValueError: the HDF5 cannot be read.
        """
        if self.pairs is None or self.metadata is None:
            self._refuse_unreadable()
            missing = PAIRS_FILE if self.pairs is None else METADATA_FILE
            other = self.metadata if self.pairs is None else self.pairs
            half = f", found only {other}" if other else ""
            raise FileNotFoundError(f"{self.folder}: found no {missing.name}{half}; expected {missing} in it")
        return self.pairs, self.metadata

    def require_slicing(self) -> Path:
        """The keyframe HDF5; raises as :meth:`require_pairs`."""
        if self.slicing is None:
            self._refuse_unreadable()
            raise FileNotFoundError(f"{self.folder}: found no keyframe HDF5; expected {SLICING_FILE} in it")
        return self.slicing

    def describe(self) -> str:
        """One line per part: what was found."""
        parts = {
            "extrapolation HDF5": self.pairs,
            "extrapolation CSV": self.metadata,
            "slicing HDF5": self.slicing,
            "raw sequences": f"{len(self.raw)} .npz" if self.raw else None,
            "sequence lists": ", ".join(str(path) for path in self.lists.values()) or None,
        }
        return "\n".join(f"{name}: {found or 'none'}" for name, found in parts.items())

    def _refuse_unreadable(self) -> None:
        """Raise if what is missing may be a file that cannot be read."""
        if self.unreadable:
            raise ValueError(self.unreadable[0])


def hdf5_kind(path: Path) -> str:
    """``"pairs"``, ``"slicing"``, ``"recording"`` or ``"other"``, by what is inside, not by the name.

    Raises:
        FileNotFoundError, ValueError: missing or not HDF5.
    """
    with Hdf5Reader(path) as reader:
        root = reader.file
        if root.attrs.get("schema", b"") in (SCHEMA, SCHEMA.encode()):
            return "recording"
        if any(isinstance(root.get(f"{split}/event_frames"), h5py.Dataset) for split in SPLITS):
            return "slicing"
        for name in root:
            group = root.get(name)
            if isinstance(group, h5py.Group) and ("depth_frames" in group or "events" in group):
                return "pairs"
    return "other"


def find_files(folder: Path) -> ElidarFiles:
    """Look for ELiDAR's files in ``folder`` and the folders below it, whatever their names.

    Raises:
        FileNotFoundError: the folder does not exist or holds none of them.
        ValueError: two files could be the same part, or there are only HDF5 files that cannot be read.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: not a folder; expected the folder with ELiDAR's files")
    files = sorted(_walk(folder, SEARCH_DEPTH))
    by_kind: dict[str, list[Path]] = {"pairs": [], "slicing": [], "recording": [], "other": []}
    unreadable = []
    for path in files:
        if path.suffix in HDF5_SUFFIXES:
            try:
                by_kind[hdf5_kind(path)].append(path)
            except ValueError as error:
                unreadable.append(str(error))
    metadata = [path for path in files if path.suffix == ".csv" and _is_metadata(path)]
    raw: dict[str, list[Path]] = {}
    for path in files:
        if path.suffix == ".npz" and _is_raw(path):
            raw.setdefault(path.stem, []).append(path)
    found = ElidarFiles(
        folder,
        pairs=_only(folder, "extrapolation HDF5", by_kind["pairs"]),
        metadata=_only(folder, "extrapolation CSV", metadata),
        slicing=_only(folder, "slicing HDF5", by_kind["slicing"]),
        raw={name: paths[0] for name, paths in raw.items() if _only(folder, f"raw {name}", paths)},
        lists={
            split: paths[0]
            for split, name in SEQUENCE_LISTS.items()
            if (paths := [path for path in files if path.name == name.name])
        },
        unreadable=tuple(unreadable),
    )
    if not any((found.pairs, found.metadata, found.slicing, found.raw)):
        if unreadable:
            raise ValueError(unreadable[0])
        raise FileNotFoundError(
            f"{folder}: found none of ELiDAR's files, expected {PAIRS_FILE} with {METADATA_FILE}, "
            f"{SLICING_FILE} or {RAW_FOLDER}/*.npz"
        )
    return found


def elidar_in(folder: Path) -> ElidarFiles | None:
    """ELiDAR's files in ``folder``, or None where it has none or is a folder of recordings.

    Raises:
        ValueError: as :func:`find_files`.
    """
    if not folder.is_dir() or (folder / MANIFEST).is_file():
        return None
    try:
        return find_files(folder)
    except FileNotFoundError:
        return None


def _walk(folder: Path, depth: int) -> Iterable[Path]:
    """Files of ``folder`` and of the folders at most ``depth`` below; hidden ones are left out."""
    for path in folder.iterdir():
        if path.name.startswith("."):
            continue
        if path.is_dir():
            if depth:
                yield from _walk(path, depth - 1)
        else:
            yield path


def _is_metadata(path: Path) -> bool:
    """Whether the first line names a column that only ELiDAR's CSV has; separators are judged later."""
    with open(path, "rb") as file:
        return b"prior_depth_frame_id" in file.readline(4096)


def _is_raw(path: Path) -> bool:
    """Whether an archive holds event frames; a damaged one counts, so that its reader can say so."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "frames.npy" in archive.namelist()
    except (zipfile.BadZipFile, OSError):
        return True


def _only(folder: Path, what: str, paths: list[Path]) -> Path | None:
    if len(paths) > 1:
        raise ValueError(
            f"{folder}: found {len(paths)} files for {what}, expected one: {', '.join(map(str, paths))}"
        )
    return paths[0] if paths else None
