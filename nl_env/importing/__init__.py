"""Real recordings of other projects as native ones: event files, depth maps, crop and binning.

:func:`open_events` reads DSEC, M3ED and EvTTC (HDF5 with an index by millisecond) and Prophesee's DAT, EVT2
and EVT3; :func:`open_depth` reads depth, :class:`PoseTrack` poses, :class:`NavigationTrack` speeds;
:class:`RectifiedEvents` moves DSEC's events to where its disparity is; :func:`import_recording` writes a
recording that replays.
``docs/importing.md`` says what each file holds, and what an imported recording does not.
"""

from nl_env.importing.convert import Imported, import_recording
from nl_env.importing.depth_maps import DepthMaps, depth_in
from nl_env.importing.dsec import DisparityMaps, RectifiedEvents, StereoCalibration
from nl_env.importing.files import EVENT_SUFFIXES, cameras_in, open_depth, open_events
from nl_env.importing.ms_indexed import MsIndexedEvents
from nl_env.importing.navigation import NavigationTrack, holds_navigation
from nl_env.importing.options import ImportOptions
from nl_env.importing.poses import PoseTrack, holds_poses
from nl_env.importing.prophesee import DatEvents, Evt2Events, Evt3Events
from nl_env.importing.source import Calibration, DepthSource, EventSource

__all__ = [
    "EVENT_SUFFIXES",
    "Calibration",
    "DatEvents",
    "DepthMaps",
    "DepthSource",
    "DisparityMaps",
    "EventSource",
    "Evt2Events",
    "Evt3Events",
    "ImportOptions",
    "Imported",
    "MsIndexedEvents",
    "NavigationTrack",
    "PoseTrack",
    "RectifiedEvents",
    "StereoCalibration",
    "cameras_in",
    "depth_in",
    "holds_navigation",
    "holds_poses",
    "import_recording",
    "open_depth",
    "open_events",
]
