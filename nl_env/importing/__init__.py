"""Real recordings of other projects as native ones: event files, depth maps, crop and binning.

:func:`open_events` reads DSEC, M3ED and EvTTC (HDF5 with an index by millisecond) and Prophesee's DAT, EVT2
and EVT3; :class:`DepthMaps` reads depth; :func:`import_recording` writes a recording that replays.
``docs/importing.md`` says what each file holds, and what an imported recording does not.
"""

from nl_env.importing.convert import Imported, ImportOptions, import_recording
from nl_env.importing.depth_maps import DepthMaps
from nl_env.importing.files import EVENT_SUFFIXES, cameras_in, open_events
from nl_env.importing.ms_indexed import MsIndexedEvents
from nl_env.importing.prophesee import DatEvents, Evt2Events, Evt3Events
from nl_env.importing.source import Calibration, EventSource

__all__ = [
    "EVENT_SUFFIXES",
    "Calibration",
    "DatEvents",
    "DepthMaps",
    "EventSource",
    "Evt2Events",
    "Evt3Events",
    "ImportOptions",
    "Imported",
    "MsIndexedEvents",
    "cameras_in",
    "import_recording",
    "open_events",
]
