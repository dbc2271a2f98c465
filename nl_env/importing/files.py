"""Which reader a file of events or of depth needs."""

from __future__ import annotations

from pathlib import Path

from nl_env.elidar.hdf5 import Hdf5Reader
from nl_env.elidar.layout import HDF5_SUFFIXES
from nl_env.importing.depth_maps import DepthMaps
from nl_env.importing.dsec import DisparityMaps, StereoCalibration
from nl_env.importing.ms_indexed import CAMERAS, MsIndexedEvents, find_layout
from nl_env.importing.prophesee import DatEvents, Evt2Events, Evt3Events, open_raw

RAW_SUFFIX, DAT_SUFFIX = ".raw", ".dat"
EVENT_SUFFIXES = (RAW_SUFFIX, DAT_SUFFIX)
"""Of files that hold nothing but events."""

AnyEvents = MsIndexedEvents | DatEvents | Evt2Events | Evt3Events


def open_events(path: Path, camera: str = "left", sensor: tuple[int, int] | None = None) -> AnyEvents:
    """The events of a file, by its suffix and by what is in it.

    Args:
        path: ``.h5`` or ``.hdf5`` of DSEC, M3ED or EvTTC, ``.raw`` or ``.dat``.
        camera: ``"left"`` or ``"right"``, where a file holds both.
        sensor: ``(H, W)``, for Prophesee files that do not say.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another kind of file, or a damaged one.
        ImportError: an EVT 3.0 file without the package that decodes it.
    """
    suffix = path.suffix.lower()
    if suffix in HDF5_SUFFIXES:
        return MsIndexedEvents(path, camera)
    if suffix == RAW_SUFFIX:
        return open_raw(path, sensor)
    if suffix == DAT_SUFFIX:
        return DatEvents(path, sensor)
    known = ", ".join((*HDF5_SUFFIXES, *EVENT_SUFFIXES))
    raise ValueError(f"{path}: found {suffix or 'no suffix'}, expected one of {known}")


def open_depth(
    path: Path, camera: str = "left", calibration: StereoCalibration | None = None
) -> DepthMaps | DisparityMaps:
    """The depth maps of an HDF5 file, or DSEC's disparity in a folder.

    Args:
        path: the file or folder.
        camera: ``"left"`` or ``"right"``, where a file may hold both.
        calibration: of DSEC; a folder needs it.

    Raises:
        FileNotFoundError: nothing there, or half of it.
        ValueError: damage, a folder without a calibration, or disparity for the right camera.
    """
    if not path.is_dir():
        return DepthMaps(path, camera)
    if calibration is None:
        raise ValueError(f"{path}: found a folder, DSEC's disparity, expected its --calibration, too")
    if camera != "left":
        raise ValueError(f"camera: found {camera!r}, but DSEC's disparity ({path}) is the left camera's")
    return DisparityMaps(path, calibration)


def cameras_in(path: Path) -> tuple[str, ...]:
    """The cameras whose events :func:`open_events` finds in a file; none if it is no event file.

    A file of one camera counts as the left one's, as in DSEC, which has a file for each.

    Raises:
        FileNotFoundError, ValueError: a missing or unreadable HDF5 file.
    """
    if path.suffix.lower() in EVENT_SUFFIXES:
        return CAMERAS[:1]
    if path.suffix.lower() not in HDF5_SUFFIXES:
        return ()
    with Hdf5Reader(path) as reader:
        found = {camera: find_layout(reader.file, camera) for camera in CAMERAS}
    groups: list[str] = []
    cameras: list[str] = []
    for camera, layout in found.items():
        if layout is not None and layout.group not in groups:
            groups.append(layout.group)
            cameras.append(camera)
    return tuple(cameras)
