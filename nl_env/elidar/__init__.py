"""ELiDAR, the NeuroLiDAR authors' data set: reading its files, rebuilding their time, writing its layout.

``docs/data.md`` describes the files.
"""

from nl_env.elidar.layout import (
    ElidarFiles,
    elidar_in,
    find_files,
    parse_sequence_name,
    read_sequence_list,
)
from nl_env.elidar.metadata import Metadata, Problem, SequencePairs, read_metadata
from nl_env.elidar.pairs import ExtrapolationData, Pair
from nl_env.elidar.slicing import RawSequence, SlicingData
from nl_env.elidar.timeline import frame_ticks, previous_frame, rebuild_timelines

__all__ = [
    "ElidarFiles",
    "ExtrapolationData",
    "Metadata",
    "Pair",
    "Problem",
    "RawSequence",
    "SequencePairs",
    "SlicingData",
    "elidar_in",
    "find_files",
    "frame_ticks",
    "parse_sequence_name",
    "previous_frame",
    "read_metadata",
    "read_sequence_list",
    "rebuild_timelines",
]
