"""Keeping large blocks of memory inside the process between the layers of a network.

A layer's output at 480x640 is tens of megabytes. By default glibc maps such a block when it is wanted and
gives it back to the kernel when it is freed, so the next layer's output is mapped, zeroed and faulted in
page by page again: up to half of the time of a U-Net that runs layer by layer. With the thresholds raised,
freed blocks stay and are used again. The price: the process keeps the most memory it ever used at once
(about 200 MB for the released network at 480x640).
"""

from __future__ import annotations

import ctypes
import os
import platform
from functools import cache

VARIABLE = "NL_ENV_MALLOPT"
"""Environment variable; ``0`` leaves the allocator as it is."""

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3  # <malloc.h>
_THRESHOLDS = (1 << 30, 1 << 25)
"""Bytes; glibc before 2.35 takes no mmap threshold above 32 MiB."""
_PAD = 1 << 24
"""Bytes the heap grows by at least."""


@cache
def keep_large_blocks() -> bool:
    """Tell glibc, once for the whole process, to keep freed blocks of up to 1 GiB.

    Returns:
        Whether it was told: False with another C library or with ``NL_ENV_MALLOPT=0``.
    """
    if os.environ.get(VARIABLE) == "0" or platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    mallopt.argtypes, mallopt.restype = (ctypes.c_int, ctypes.c_int), ctypes.c_int
    if not any(mallopt(_MMAP_THRESHOLD, threshold) for threshold in _THRESHOLDS):
        return False
    return bool(mallopt(_TRIM_THRESHOLD, _THRESHOLDS[0])) and bool(mallopt(_TOP_PAD, _PAD))
