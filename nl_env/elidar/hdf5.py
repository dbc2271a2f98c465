"""Reading HDF5 files that others wrote: opened lazily and per process, every failure says where and why."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray


class Hdf5Reader:
    """One HDF5 file, opened on first use in each process; pickles as its path.

    Args:
        path: the file. It is not touched before the first read.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._file: h5py.File | None = None
        self._process = 0

    def __enter__(self) -> Hdf5Reader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "_file": None, "_process": 0}

    @property
    def file(self) -> h5py.File:
        """The open file.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not an HDF5 file, or a truncated one.
        """
        if self._file is None or self._process != os.getpid():
            if not self.path.is_file():
                raise FileNotFoundError(f"{self.path}: no such file; expected an HDF5 file")
            self._file = _opened(self.path)
            self._process = os.getpid()
        return self._file

    def close(self) -> None:
        """Close the file; it opens again when it is needed. May be called twice."""
        if self._file is not None and self._process == os.getpid():
            self._file.close()
        self._file = None

    def dataset(self, name: str) -> h5py.Dataset:
        """Dataset ``name`` with numbers in it.

        Raises:
            ValueError: missing, a group, or not numeric.
        """
        try:
            found = self.file.get(name)
        except (OSError, RuntimeError, KeyError) as error:
            raise ValueError(f"{self.path}: {name}: cannot be read ({error})") from error
        if not isinstance(found, h5py.Dataset):
            inside = "a group" if isinstance(found, h5py.Group) else "nothing"
            raise ValueError(f"{self.path}: {name}: found {inside}, expected a dataset")
        dtype = h5py.check_vlen_dtype(found.dtype) or found.dtype
        if np.dtype(dtype).kind not in "iufb":
            raise ValueError(f"{self.path}: {name}: found {found.dtype}, expected numbers")
        return found

    def read(self, name: str, index: int | slice | Sequence[int]) -> NDArray[Any]:
        """Rows ``index`` of dataset ``name``.

        Raises:
            ValueError: an index out of range, a damaged chunk, or a compression filter that is not installed.
        """
        dataset = self.dataset(name)
        rows = dataset.shape[0] if dataset.shape else 0
        if isinstance(index, int) and not 0 <= index < rows:
            raise ValueError(f"{self.path}: {name}: found index {index}, expected 0 to {rows - 1}")
        try:
            return np.asarray(dataset[index])
        except (OSError, RuntimeError) as error:
            missing = missing_filters(dataset)
            if missing:
                raise ValueError(
                    f"{self.path}: {name}: compressed with {', '.join(missing)}, which is not installed; "
                    "install hdf5plugin and import it before reading"
                ) from error
            raise ValueError(f"{self.path}: {name}[{index}]: damaged or truncated ({error})") from error


def _opened(path: Path) -> h5py.File:
    """The file, locked as h5py does by itself where that works: a folder on a network may not allow it."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        try:
            return h5py.File(path, "r", locking=False)
        except OSError:
            raise ValueError(f"{path}: not a readable HDF5 file ({error})") from error


def missing_filters(dataset: h5py.Dataset) -> list[str]:
    """Names and numbers of the compression filters a dataset needs and this installation lacks."""
    properties = dataset.id.get_create_plist()
    filters = [properties.get_filter(k) for k in range(properties.get_nfilters())]
    return [
        f"filter {code} ({name.decode(errors='replace') or 'unnamed'})"
        for code, _, _, name in filters
        if not h5py.h5z.filter_avail(code)
    ]
