"""Recordings: one sequence of the synthetic sensors per HDF5 file, exact to the last bit.

:func:`record_sequence` writes, :class:`Recording` reads and verifies; ``docs/recordings.md`` describes the
file for those who read it without this package.
"""

from nl_env.recording.reader import Recording
from nl_env.recording.writer import record_sequence

__all__ = ["Recording", "record_sequence"]
