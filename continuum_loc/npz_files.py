"""
Archives of arrays (.npz) whose promises are checked before any memory is taken.

NumPy takes the memory that an array's header asks for before it looks whether the data are there,
and an archive of a kilobyte can unfold to a gigabyte. Nothing that could run code is loaded.
"""

from __future__ import annotations

from collections import Counter
import math
from pathlib import Path
from typing import Any
import zipfile
import zlib

import numpy as np

SMALL = 256_000_000  # bytes that any archive may unfold to
MOST_UNFOLDED = 100  # times its own size, beyond that; arrays of measurements reach five
_UNREADABLE = (
    OSError,
    EOFError,
    KeyError,
    ValueError,
    TypeError,
    RuntimeError,  # an encrypted archive
    NotImplementedError,  # an unknown compression
    MemoryError,
    zlib.error,
    zipfile.BadZipFile,
)


class NotAnArchive(ValueError):
    """A file that is no archive of plain arrays, or a damaged one."""


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """
    Read all arrays of an archive, by name.

    Raises NotAnArchive with the reason; the caller names the file and what it should have been.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            _check_sizes(members, Path(path).stat().st_size)
            return {
                member.filename.removesuffix('.npy'): _array(archive, member) for member in members
            }
    except _UNREADABLE as error:
        if isinstance(error, NotAnArchive):
            raise
        raise NotAnArchive(str(error) or type(error).__name__) from None


def _check_sizes(members: list[zipfile.ZipInfo], size: int) -> None:
    names = [member.filename for member in members]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise NotAnArchive(f'{twice[0]} is in it twice')
    unfolded = sum(member.file_size for member in members)
    if unfolded > max(SMALL, MOST_UNFOLDED * size):
        raise NotAnArchive(f'its {size:,} bytes would unfold to {unfolded:,}')


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        shape, fortran, kind = _header(stream)
        if kind.hasobject:
            raise NotAnArchive(f'{member.filename} holds objects, not numbers')
        there = member.file_size - stream.tell()
        promised = math.prod((kind.itemsize, *shape))  # whole numbers of Python, which do not wrap
        if promised != there:
            raise NotAnArchive(
                f'{member.filename} says {shape} of {kind}, which are {promised:,} bytes, '
                f'and holds {there:,}'
            )
        data = bytearray(there)
        filled = 0
        while filled < there:
            count = stream.readinto(memoryview(data)[filled:])
            if not count:
                raise NotAnArchive(f'{member.filename} ends after {filled:,} of {there:,} bytes')
            filled += count
        stream.read(1)  # to its end, where the check sum is compared
    return np.ndarray(shape, kind, data, order='F' if fortran else 'C')


def _header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise NotAnArchive(f'arrays of version {version}')
    read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    return read[version[0]](stream)
