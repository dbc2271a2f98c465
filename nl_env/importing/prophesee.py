"""Prophesee's event files: DAT, and RAW in EVT 2.0 and EVT 3.0.

DAT and EVT 2.0 are words of fixed length and are read here as they are documented; EVT 3.0 is decoded by the
package ``evt3``, which is optional.
"""

from __future__ import annotations

import importlib
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nl_env.importing.source import Calibration, EventChecker, between

BLOCK_WORDS = 1 << 20
"""Words that are decoded at a time."""
BLOCK_BYTES = 1 << 21

DAT_DTYPE = np.dtype([("t", "<u4"), ("word", "<u4")])
DAT_EVENT_TYPES = (0x00, 0x0C)
"""Event2d and EventCD."""

EVT2_OFF, EVT2_ON, EVT2_TIME_HIGH = 0x0, 0x1, 0x8

MAX_HEADER = 1 << 16


class Header:
    """The text at the beginning of a file: lines ``% keyword value``.

    Args:
        path: the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such text.

    Attributes:
        values: by keyword, in lower case.
        end: bytes it takes.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; expected a Prophesee recording")
        self.path = path
        self.values: dict[str, str] = {}
        with open(path, "rb") as file:
            text = file.read(MAX_HEADER)
        self.end = 0
        while text[self.end : self.end + 2] == b"% ":
            stop = text.find(b"\n", self.end)
            if stop < 0:
                raise ValueError(f"{path}: found a header without an end, expected lines that begin with %")
            keyword, _, value = text[self.end + 1 : stop].decode("latin-1").strip().partition(" ")
            self.values[keyword.lower()] = value.strip()
            self.end = stop + 1
            if keyword == "end":
                break
        if not self.end:
            raise ValueError(f"{path}: found no header, expected lines that begin with %")

    @property
    def encoding(self) -> str | None:
        """``"2.0"``, ``"3.0"``, ... of a RAW file; None if it does not say."""
        if "evt" in self.values:
            return self.values["evt"]
        match = re.match(r"EVT(\d)(\d?)", self.values.get("format", ""))
        return f"{match[1]}.{match[2] or 0}" if match else None

    def shape(self, fallback: tuple[int, int] | None) -> tuple[int, int]:
        """``(H, W)`` of the sensor; raises ``ValueError`` where neither the file nor the caller says it."""
        said = self.values
        sizes = re.search(r"height=(\d+);width=(\d+)", said.get("format", ""))
        geometry = re.fullmatch(r"(\d+)x(\d+)", said.get("geometry", ""))
        if sizes:
            shape = int(sizes[1]), int(sizes[2])
        elif geometry:
            shape = int(geometry[2]), int(geometry[1])
        elif said.get("height", "").isdecimal() and said.get("width", "").isdecimal():
            shape = int(said["height"]), int(said["width"])
        elif fallback is not None:
            shape = fallback
        else:
            raise ValueError(
                f"{self.path}: found no sensor size in its header, expected --sensor WIDTH HEIGHT"
            )
        if min(shape) < 1:
            raise ValueError(
                f"{self.path}: found a sensor of {shape[0]}x{shape[1]}, expected at least one pixel"
            )
        return shape


class PropheseeEvents(ABC):
    """What the three formats share; an :class:`nl_env.importing.EventSource`.

    There is no index: a window is found by decoding what comes before it, and the last event by decoding
    everything, once.

    Args:
        path: the file.
        shape: ``(H, W)`` of the sensor where the header does not say.

    Raises:
        FileNotFoundError, ValueError: as :class:`Header`; a file of another format or cut off.
    """

    layout: str
    calibration: Calibration | None = None

    def __init__(self, path: str | Path, shape: tuple[int, int] | None = None) -> None:
        self.path = Path(path)
        self._header = Header(self.path)
        self.shape = self._header.shape(shape)
        self._scanned: tuple[int, int, int] | None = None

    def __len__(self) -> int:
        return self._scan()[2]

    def span(self) -> tuple[int, int]:
        """Times of the first and of the last event, us since the camera started.

        Raises:
            ValueError: no event at all, or damage.
        """
        return self._scan()[:2]

    def blocks(self, start_us: int, stop_us: int) -> Iterator[NDArray[np.void]]:
        """Events of ``[start_us, stop_us)`` in order."""
        for events in self._checked():
            yield between(events, start_us, stop_us)
            if len(events) and events["t"][-1] >= stop_us:
                return

    def verify(self) -> None:
        """Decode everything; raises ``ValueError`` with the first damage."""
        for _ in self._checked():
            pass

    def close(self) -> None:  # noqa: B027 - part of the protocol, with nothing to do here
        """Nothing stays open between calls."""

    def _scan(self) -> tuple[int, int, int]:
        """Times of the first and of the last event, and how many there are."""
        if self._scanned is None:
            first = last = None
            count = 0
            for events in self._checked():
                if len(events):
                    first = int(events["t"][0]) if first is None else first
                    last = int(events["t"][-1])
                    count += len(events)
            if first is None or last is None:
                raise ValueError(f"{self.path}: found no events, expected at least one")
            self._scanned = first, last, count
        return self._scanned

    def _checked(self) -> Iterator[NDArray[np.void]]:
        checker = EventChecker(str(self.path), self.shape)
        first = 0
        for t, x, y, p in self._decoded():
            yield checker(first, t, x, y, p)
            first += len(t)

    @abstractmethod
    def _decoded(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Columns t, x, y, p of successive events."""

    def _words(self, dtype: Any, begin: int) -> NDArray[Any]:
        """The file from ``begin`` on, mapped; raises ``ValueError`` unless it is a whole number of words."""
        kind = np.dtype(dtype)
        rest = self.path.stat().st_size - begin
        if rest % kind.itemsize:
            raise ValueError(
                f"{self.path}: found {rest} bytes after the header, "
                f"expected a multiple of {kind.itemsize}: the file is cut off"
            )
        if rest <= 0:
            return np.empty(0, kind)
        return np.memmap(self.path, kind, mode="r", offset=begin)


class DatEvents(PropheseeEvents):
    """DAT version 2: eight bytes per event, time and then polarity, row and column in one word."""

    layout = "DAT"

    def __init__(self, path: str | Path, shape: tuple[int, int] | None = None) -> None:
        super().__init__(path, shape)
        version = self._header.values.get("version")
        if version != "2":
            raise ValueError(f"{self.path}: found version {version} of DAT, expected 2")
        with open(self.path, "rb") as file:
            file.seek(self._header.end)
            kind = file.read(2)
        if len(kind) != 2 or kind[0] not in DAT_EVENT_TYPES or kind[1] != DAT_DTYPE.itemsize:
            raise ValueError(
                f"{self.path}: found event type and size {tuple(kind)}, "
                f"expected type {DAT_EVENT_TYPES[0]} or {DAT_EVENT_TYPES[1]} of 8 bytes"
            )

    def _decoded(self) -> Iterator[tuple[NDArray[Any], ...]]:
        records = self._words(DAT_DTYPE, self._header.end + 2)
        for begin in range(0, len(records), BLOCK_WORDS):
            block = records[begin : begin + BLOCK_WORDS]
            word = block["word"]
            yield block["t"], word & 0x3FFF, word >> 14 & 0x3FFF, word >> 28 & 1


class Evt2Events(PropheseeEvents):
    """RAW in EVT 2.0: 32-bit words, events with the lowest 6 bits of their time, and words with the rest."""

    layout = "EVT2"

    def __init__(self, path: str | Path, shape: tuple[int, int] | None = None) -> None:
        super().__init__(path, shape)
        _require_encoding(self._header, "2.0")

    def _decoded(self) -> Iterator[tuple[NDArray[Any], ...]]:
        words = self._words("<u4", self._header.end)
        high = -1  # upper 28 bits of the time; events before the first such word have no time
        for begin in range(0, len(words), BLOCK_WORDS):
            block = np.asarray(words[begin : begin + BLOCK_WORDS])
            kind = block >> 28
            is_time = kind == EVT2_TIME_HIGH
            latest = np.maximum.accumulate(np.where(is_time, np.arange(len(block)), -1))
            upper = np.where(latest < 0, high, (block[latest] & 0x0FFF_FFFF).astype(np.int64))
            high = int(upper[-1])
            chosen = ((kind == EVT2_OFF) | (kind == EVT2_ON)) & (upper >= 0)
            event = block[chosen]
            t = upper[chosen] << 6 | (event >> 22 & 0x3F).astype(np.int64)
            yield t, event >> 11 & 0x7FF, event & 0x7FF, kind[chosen]


class Evt3Events(PropheseeEvents):
    """RAW in EVT 3.0, decoded by the package ``evt3``.

    Raises:
        ImportError: that package is not installed.
    """

    layout = "EVT3"

    def __init__(self, path: str | Path, shape: tuple[int, int] | None = None) -> None:
        super().__init__(path, shape)
        _require_encoding(self._header, "3.0")
        try:
            self._decoder = importlib.import_module("evt3")
        except ImportError as error:
            raise ImportError(
                f"{self.path}: EVT 3.0 needs the package evt3 (pip install 'nl-env[importing]')"
            ) from error

    def _decoded(self) -> Iterator[tuple[NDArray[Any], ...]]:
        try:
            for events in self._decoder.FileDecoder(str(self.path), batch_bytes=BLOCK_BYTES):
                yield events.t, events.x, events.y, events.p
        except OSError as error:
            raise ValueError(f"{self.path}: damaged or cut off ({error})") from error


RAW_READERS: dict[str, type[Evt2Events | Evt3Events]] = {"2.0": Evt2Events, "3.0": Evt3Events}


def open_raw(path: Path, shape: tuple[int, int] | None = None) -> Evt2Events | Evt3Events:
    """A RAW file by the encoding that its header names.

    Raises:
        FileNotFoundError, ValueError, ImportError: as the classes.
    """
    encoding = Header(path).encoding
    if encoding not in RAW_READERS:
        raise ValueError(f"{path}: found the encoding {encoding}, expected evt 2.0 or 3.0 in its header")
    return RAW_READERS[encoding](path, shape)


def _require_encoding(header: Header, wanted: str) -> None:
    if header.encoding != wanted:
        raise ValueError(f"{header.path}: found the encoding {header.encoding}, expected evt {wanted}")
