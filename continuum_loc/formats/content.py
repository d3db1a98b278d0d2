"""The bytes of a file, unpacked where its name ends with `.gz`."""

from __future__ import annotations

import os
from pathlib import Path
import zlib

from continuum_loc.errors import MapError

MOST_MEMORY = 0.5  # share of the machine's that a file may have; reading it takes as much again
SMALL = 64_000_000  # bytes that any packed file may unfold to
MOST_UNFOLDED = 100  # times the packed size, beyond that; tables of numbers reach ten
_CHUNK = 1 << 20


def bytes_of(path: Path) -> bytes:
    """
    Read a file whole.

    Raises MapError where there is none, it cannot be read, or unfolds to more than it may.
    """
    if not path.is_file():
        raise MapError(f'{path}: {_what_it_is(path)}')
    memory = os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE')
    if path.stat().st_size > MOST_MEMORY * memory:
        raise MapError(f'{path}: does not fit into memory')
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MapError(f'{path}: cannot be read ({error.strerror})') from None
    except MemoryError:
        raise MapError(f'{path}: does not fit into memory') from None
    if not data:
        raise MapError(f'{path}: the file is empty')
    return _unpacked(data, path) if path.suffix.lower() == '.gz' else data


def _what_it_is(path: Path) -> str:
    if path.is_dir():
        return 'a folder, not a file'
    return 'not a plain file' if path.exists() else 'there is no such file'


def _unpacked(data: bytes, path: Path) -> bytes:
    """Unpack gzip members one after the other, within the limits."""
    most, parts, size = max(SMALL, MOST_UNFOLDED * len(data)), [], 0
    try:
        while data:
            unpack = zlib.decompressobj(wbits=31)  # 31: with the header and check sum of gzip
            while not unpack.eof:
                part = unpack.decompress(data, _CHUNK)
                data = unpack.unconsumed_tail
                if not part and not data and not unpack.eof:
                    raise MapError(f'{path}: ends before its packed data do: it was cut')
                parts.append(part)
                size += len(part)
                if size > most:
                    raise MapError(f'{path}: unfolds to more than {most:,} bytes')
            data = unpack.unused_data.lstrip(b'\0')
    except zlib.error as error:
        raise MapError(f'{path}: not a gzip file that can be unpacked ({error})') from None
    return b''.join(parts)
