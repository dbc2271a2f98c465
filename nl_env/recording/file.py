"""A recording as an HDF5 file: opened late, once per process, and every read checked."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from nl_env.recording.chunks import ChunkReader
from nl_env.recording.schema import CHECKSUM, Header

VERIFY_BYTES = 1 << 22
"""Raw bytes that :meth:`RecordingFile.verify` holds at a time."""


class RecordingFile:
    """The header and the datasets of one recording.

    Opened at the first access. Copies sent to other processes carry the path only, and a forked child
    opens the file anew.

    Args:
        path: the HDF5 file.

    Raises:
        FileNotFoundError: at the first access, where there is no file.
        ValueError: at any access, on damage; names the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: h5py.File | None = None
        self._process = 0
        self._header: Header | None = None
        self._datasets: dict[str, h5py.Dataset] = {}
        self._readers: dict[str, ChunkReader | None] = {}
        self._lock = threading.Lock()
        self._arrays: dict[str, NDArray[Any]] = {}

    @property
    def header(self) -> Header:
        """Everything that is not an array."""
        self._open()
        assert self._header is not None
        return self._header

    def rows(self, name: str) -> int:
        """Length of a dataset."""
        self._open()
        return int(self._datasets[name].shape[0])

    def read(self, name: str, first: int, last: int) -> NDArray[Any]:
        """Rows ``[first, last)`` of a dataset."""
        return self.look(name, first, last).copy()

    def look(self, name: str, first: int, last: int) -> NDArray[Any]:
        """:meth:`read` without a copy where there need not be one: not to be written to."""
        self._open()
        try:
            with self._lock:
                if name not in self._readers:
                    self._readers[name] = ChunkReader.of(self._datasets[name])
                reader = self._readers[name]
                rows = None if reader is None else reader.rows(first, last)
            return self._datasets[name][first:last] if rows is None else rows
        except DAMAGE as error:
            raise _damaged(self.path, name, error) from error

    def array(self, name: str, check: Callable[[NDArray[Any]], None] | None = None) -> NDArray[Any]:
        """A whole small dataset, read and checked once, and kept; read-only."""
        self._open()
        array = self._arrays.get(name)
        if array is None:
            with naming_damage(self.path, name):
                array = self._datasets[name][:]
            array.flags.writeable = False
            if check is not None:
                check(array)
            self._arrays[name] = array
        return array

    def verify(self) -> None:
        """Compare every dataset with its checksum; raises ``ValueError`` naming the first that differs."""
        for name in self.header.columns:
            with naming_damage(self.path, name):
                dataset = self._datasets[name]
                stored = dataset.attrs[CHECKSUM].decode("ascii")
                row_bytes = max(dataset.nbytes // max(len(dataset), 1), 1)
                rows = max(VERIFY_BYTES // row_bytes // dataset.chunks[0], 1) * dataset.chunks[0]
                sha = hashlib.sha256()
                for first in range(0, len(dataset), rows):
                    sha.update(np.ascontiguousarray(dataset[first : first + rows]).data)
            if sha.hexdigest() != stored:
                raise ValueError(f"{self.path}: {name}: found SHA-256 {sha.hexdigest()}, expected {stored}")

    def close(self) -> None:
        """Close the file; may be called twice. The next access opens it again."""
        if self._file is not None and self._process == os.getpid():
            self._file.close()
        self._file = None
        self._header = None
        self._datasets = {}
        self._readers = {}
        self._arrays = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return RecordingFile, (self.path,)

    def _open(self) -> None:
        if self._file is not None and self._process == os.getpid():
            return
        self.close()
        with naming_damage(self.path, "not a readable recording"):
            file = h5py.File(self.path, "r", locking=False)  # finished files never change
            try:
                header = Header.read(file)
                header.check(file)
                self._datasets = {name: file[name] for name in header.columns}
            except BaseException:
                file.close()
                raise
        self._file, self._header, self._process = file, header, os.getpid()
        self._lock = threading.Lock()  # a forked child may have inherited one that is held


DAMAGE = (OSError, KeyError, RuntimeError, TypeError, ValueError, AttributeError)
"""What reading a damaged file raises."""


@contextmanager
def naming_damage(path: Path, what: str) -> Iterator[None]:
    """Turn whatever damage raises into ``ValueError`` that names the file; a missing file stays one."""
    try:
        yield
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damaged(path, what, error) from error


def _damaged(path: Path, what: str, error: Exception) -> ValueError:
    return ValueError(f"{path}: {what} ({error})")
