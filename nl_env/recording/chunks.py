"""Rows of a compressed dataset at half of what HDF5 takes: libdeflate decompresses them.

Only for chunks as recordings have them (shuffle, gzip, fletcher32), in a file that the operating system
reads. Whatever else turns up is left to HDF5, and so is the verdict on what cannot be decompressed. Chunks
are held against the checksum inside the compressed data, which covers the values themselves.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from typing import Any

import deflate
import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

KEPT = 2
"""Latest chunks that a dataset keeps, so that rows that are asked for in order are decompressed once."""

_FILTERS = [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32]
_CHECKSUM_BYTES = 4
"""Fletcher32 behind the compressed data."""


class ChunkReader:
    """Reads rows of one dataset; made by :meth:`of`."""

    def __init__(self, dataset: h5py.Dataset, descriptor: int) -> None:
        self._dtype = dataset.dtype
        self._row = dataset.shape[1:]
        self._rows = dataset.chunks[0]
        self._bytes = self._dtype.itemsize * int(np.prod(dataset.chunks))
        self._length = len(dataset)
        self._dataset = dataset
        self._descriptor = descriptor
        self._places: dict[int, tuple[int, int]] | None = None
        self._kept: OrderedDict[int, NDArray[Any]] = OrderedDict()

    @classmethod
    def of(cls, dataset: h5py.Dataset) -> ChunkReader | None:
        """A reader of ``dataset``, or None where it is not stored as recordings store it."""
        file = dataset.file
        properties = dataset.id.get_create_plist()
        filters = [properties.get_filter(k)[0] for k in range(properties.get_nfilters())]
        if (
            filters != _FILTERS
            or dataset.chunks[1:] != dataset.shape[1:]
            or dataset.dtype.itemsize not in (1, 2, 4)
            or dataset.dtype.byteorder == ">"
            or file.driver != "sec2"
            or file.userblock_size != 0
        ):
            return None
        return cls(dataset, file.id.get_vfd_handle())

    def rows(self, first: int, last: int) -> NDArray[Any] | None:
        """Rows ``[first, last)``, not to be written to; None where HDF5 must read them."""
        if not 0 <= first < last <= self._length:
            return None
        parts = []
        for number in range(first // self._rows, -(-last // self._rows)):
            chunk = self._chunk(number)
            if chunk is None:
                return None
            start = number * self._rows
            parts.append(chunk[max(first - start, 0) : last - start])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _chunk(self, number: int) -> NDArray[Any] | None:
        chunk = self._kept.get(number)
        if chunk is not None:
            self._kept.move_to_end(number)
            return chunk
        chunk = self._decompressed(number)
        if chunk is not None:
            if len(self._kept) == KEPT:
                self._kept.popitem(last=False)
            self._kept[number] = chunk
        return chunk

    def _decompressed(self, number: int) -> NDArray[Any] | None:
        if self._places is None:
            self._places = self._find_chunks()
        if number not in self._places:
            return None
        offset, size = self._places[number]
        packed = os.pread(self._descriptor, max(size - _CHECKSUM_BYTES, 0), offset)
        try:
            shuffled = deflate.zlib_decompress(packed, self._bytes)
        except deflate.DeflateError:
            return None
        if len(shuffled) != self._bytes:
            return None
        values = _unshuffled(np.frombuffer(shuffled, np.uint8), self._dtype)
        return values.reshape(self._rows, *self._row)

    def _find_chunks(self) -> dict[int, tuple[int, int]]:
        """Offset and size in the file of every chunk that went through all filters, by its number."""
        found = {}

        def note(chunk: Any) -> None:
            if chunk.filter_mask == 0:
                found[chunk.chunk_offset[0] // self._rows] = (chunk.byte_offset, chunk.size)

        self._dataset.id.chunk_iter(note)
        return found


def _unshuffled(planes: NDArray[np.uint8], dtype: np.dtype[Any]) -> NDArray[Any]:
    """The values whose lowest bytes come first, all of them, then all second ones, and so on."""
    values = np.empty(len(planes) // dtype.itemsize, f"<u{dtype.itemsize}")
    if dtype.itemsize == 1:
        values[...] = planes
    elif dtype.itemsize == 2:
        _join_2(planes, values)
    else:
        _join_4(planes, values)
    return values.view(dtype)


@njit(cache=True, error_model="numpy")
def _join_2(planes, values):  # type: ignore[no-untyped-def]
    n = values.size
    low, high = planes[:n], planes[n : 2 * n]
    for k in range(n):
        values[k] = np.uint16(low[k]) | np.uint16(high[k]) << np.uint16(8)


@njit(cache=True, error_model="numpy")
def _join_4(planes, values):  # type: ignore[no-untyped-def]
    n = values.size
    a, b, c, d = planes[:n], planes[n : 2 * n], planes[2 * n : 3 * n], planes[3 * n : 4 * n]
    for k in range(n):
        low = np.uint32(a[k]) | np.uint32(b[k]) << np.uint32(8)
        values[k] = low | np.uint32(c[k]) << np.uint32(16) | np.uint32(d[k]) << np.uint32(24)
