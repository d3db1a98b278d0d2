"""
The frame of an MCAP file (https://mcap.dev/spec), for files that their recorder could not close.

A file is a row of records: opcode (1 byte), length (8), content, behind magic bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import takewhile
import os
from pathlib import Path
from struct import unpack_from
from typing import BinaryIO

MAGIC = b'\x89MCAP0\r\n'
FOOTER, DATA_END = 2, 15
# Data end, then a footer that names no summary: readers then look through the data.
END = b'\x0f\x04' + bytes(7 + 4) + b'\x02\x14' + bytes(7 + 20) + MAGIC


def records(stream: BinaryIO, begin: int = len(MAGIC)) -> Iterator[tuple[int, bytes, int, bool]]:
    """
    (opcode, content, where the last whole record ends, whether this one is whole).

    Ends at the first one that is cut off. A file that does not begin as MCAP has none.
    """
    size = stream.seek(0, os.SEEK_END)
    stream.seek(0)
    if begin and stream.read(begin) != MAGIC:
        return
    place = begin
    while size - place >= 9:
        code, length = unpack_from('<BQ', stream.read(9))
        content = stream.read(min(length, size - place - 9))
        whole = len(content) == length
        place += (9 + length) * whole
        yield code, content, place, whole
        if not whole or code == FOOTER:
            return


def close_cut(path: Path) -> None:
    """
    End a file after its last whole record, so that it can be read.

    Works on a full disk: the end takes 50 bytes, for which records are given up where need be.
    Raises OSError where that fails too.
    """
    with path.open('rb') as stream:
        data = takewhile(lambda record: record[0] != DATA_END, records(stream))
        ends = [len(MAGIC), *(place for *_, place, whole in data if whole)]
    while True:
        os.truncate(path, ends.pop())
        try:
            with path.open('ab') as stream:
                stream.write(END)
            return
        except OSError:
            if not ends:
                raise
