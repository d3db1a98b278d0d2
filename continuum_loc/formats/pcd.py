"""
PCD (Point Cloud Library, version 0.7), ASCII, binary, and compressed by LZF.

A point without coordinates or without its normal (nan) belongs to the format: a depth camera
writes one for every pixel that saw nothing. Such points are left out, and counted.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
import re
import struct

from continuum_loc.compiling import kernel
from continuum_loc.errors import MapError
from continuum_loc.formats.numbers import cut_error, may_be_cut, table_of, text_of
from continuum_loc.formats.shapes import canonical, check_rest, Cloud, cloud_of, USED
import numpy as np

LONGEST_HEADER = 100_000  # bytes
MOST_UNPACKED = 100  # times the packed size; LZF reaches 88
IDENTITY = ('0', '0', '0', '1', '0', '0', '0')
_KINDS = {'F': (4, 8), 'I': (1, 2, 4, 8), 'U': (1, 2, 4, 8)}
_WORDS = ('VERSION', 'FIELDS', 'COLUMNS', 'SIZE', 'TYPE', 'COUNT')
_WORDS += ('WIDTH', 'HEIGHT', 'VIEWPOINT', 'POINTS', 'DATA')


@dataclass
class _Field:
    name: str
    kind: np.dtype
    count: int

    @property
    def size(self) -> int:
        return self.kind.itemsize * self.count


@dataclass
class _Header:
    fields: list[_Field]
    points: int
    encoding: str
    notes: tuple[str, ...]
    size: int  # bytes
    lines: int  # of text, that of DATA among them

    @property
    def point_size(self) -> int:
        return sum(field.size for field in self.fields)


def read_pcd(data: bytes, where: str) -> Cloud:
    """Read a cloud. Raises MapError."""
    header = _header(data, where)
    read = {'ascii': _ascii, 'binary': _binary, 'binary_compressed': _compressed}[header.encoding]
    cloud = cloud_of(read(data, header, where), where, incomplete=True)
    return Cloud(cloud.points, cloud.normals, cloud.planarity, header.notes + cloud.notes)


# Header


def _header(data: bytes, where: str) -> _Header:
    end = re.search(rb'(?:^|(?<=\n))DATA[ \t]+(\w+)[ \t]*\r?\n', data[:LONGEST_HEADER])
    if end is None:
        raise MapError(f'{where}: not a PCD file: no line DATA ends its header')
    said: dict[str, list[str]] = {}
    lines = text_of(data[: end.end()], where).split('\n')
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith('#'):
            continue
        if words[0] not in _WORDS or words[0] in said:
            again = ' for the second time' if words[0] in said else ''
            raise MapError(f"{where}, line {number}: '{words[0][:40]}'{again} in a PCD header")
        said[words[0]] = words[1:]
    encoding = said['DATA'][0]
    if encoding not in ('ascii', 'binary', 'binary_compressed'):
        raise MapError(
            f"{where}: DATA '{encoding[:40]}'; valid are ascii, binary and binary_compressed"
        )
    return _Header(
        _fields(said, where),
        _point_count(said, where),
        encoding,
        _viewpoint_notes(said, where),
        end.end(),
        len(lines) - 1,
    )


def _fields(said: dict[str, list[str]], where: str) -> list[_Field]:
    names = said.get('FIELDS', said.get('COLUMNS', []))
    sizes, kinds = said.get('SIZE', []), said.get('TYPE', [])
    counts = said.get('COUNT', ['1'] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise MapError(
            f'{where}: its header has {len(names)} FIELDS, {len(sizes)} SIZE, {len(kinds)} TYPE '
            f'and {len(counts)} COUNT; valid are as many of each'
        )
    rows = zip(map(canonical, names), sizes, kinds, counts, strict=True)
    fields = [_field(*row, where) for row in rows]
    used = [field.name for field in fields if field.name in USED]
    if len(set(used)) < len(used):
        raise MapError(f'{where}: its FIELDS name one of {", ".join(used)} twice')
    for field in fields:
        if field.name in USED and field.count != 1:
            raise MapError(f'{where}: field {field.name} has COUNT {field.count}; valid is 1')
    return fields


def _field(name: str, size: str, kind: str, count: str, where: str) -> _Field:
    if kind not in _KINDS or size not in map(str, _KINDS[kind]):
        raise MapError(
            f'{where}: field {name} has TYPE {kind} of SIZE {size}; valid are F of 4 or 8, I and '
            'U of 1, 2, 4 or 8'
        )
    return _Field(name, np.dtype(f'<{kind.lower()}{size}'), _number(count, f'{where}: COUNT', 1))


def _point_count(said: dict[str, list[str]], where: str) -> int:
    given = {
        name: _number((said[name] or [''])[0], f'{where}: {name}')
        for name in ('WIDTH', 'HEIGHT', 'POINTS')
        if name in said
    }
    grid = given['WIDTH'] * given.get('HEIGHT', 1) if 'WIDTH' in given else None
    points = given.get('POINTS', grid)
    if points is None or (grid is not None and grid != points):
        raise MapError(
            f'{where}: WIDTH times HEIGHT must be POINTS; its header says '
            f'{", ".join(f"{name} {value}" for name, value in given.items()) or "none of them"}'
        )
    return points


def _number(text: str, what: str, least: int = 0) -> int:
    if not re.fullmatch(r'\d{1,20}', text) or int(text) < least:
        raise MapError(f"{what} '{text[:40]}'; valid is a whole number from {least} on")
    return int(text)


def _viewpoint_notes(said: dict[str, list[str]], where: str) -> tuple[str, ...]:
    """PCL moves no point by the viewpoint, and neither do we."""
    given = said.get('VIEWPOINT', list(IDENTITY))
    try:
        values = [float(word) for word in given]
    except ValueError:
        values = []
    if len(values) != 7 or not all(map(math.isfinite, values)):
        raise MapError(f'{where}: VIEWPOINT {" ".join(given)[:80]}; valid are seven numbers')
    if values == [float(word) for word in IDENTITY]:
        return ()
    return (f'VIEWPOINT {" ".join(given)} moves no point: they are taken as they stand',)


# Data


def _ascii(data: bytes, header: _Header, where: str) -> dict[str, np.ndarray]:
    start = header.size
    if sum(field.count for field in header.fields) > len(data):  # before a name is made for each
        raise _ends(0, header, where)
    text = text_of(data[start:], where)
    lines = text.split('\n')
    kept = [k for k, line in enumerate(lines) if line.strip()]
    numbers = [header.lines + 1 + k for k in kept]
    names = [name for field in header.fields for name in [field.name] * field.count]
    body = [lines[k] for k in kept[: header.points]]
    table = table_of(body, numbers[: header.points], names, where)
    if len(kept) < header.points:
        raise _ends(len(kept), header, where)
    if len(kept) > header.points:
        raise MapError(
            f'{where}, line {numbers[header.points]}: goes on after the {header.points} points '
            'that its header says'
        )
    if names[-1] in USED and not text.endswith('\n') and may_be_cut(body):
        raise cut_error(where, numbers[-1])
    return {name: table[:, k] for k, name in enumerate(names)}


def _binary(data: bytes, header: _Header, where: str) -> dict[str, np.ndarray]:
    room = len(data) - header.size
    if header.points * header.point_size > room:
        raise _ends(room // header.point_size, header, where)
    kind = np.dtype([(f'{k}', one.kind, (one.count,)) for k, one in enumerate(header.fields)])
    table = np.frombuffer(data, kind, header.points, header.size)
    end = header.size + table.nbytes
    check_rest(data[end:], where)
    return {one.name: table[f'{k}'][:, 0] for k, one in enumerate(header.fields)}


def _compressed(data: bytes, header: _Header, where: str) -> dict[str, np.ndarray]:
    """Fields follow each other, not points: all x, then all y, and so on."""
    if len(data) < header.size + 8:
        raise _ends(0, header, where)
    packed, unpacked = struct.unpack_from('<II', data, header.size)
    there = len(data) - header.size - 8
    if packed > there:
        raise MapError(f'{where}: ends after {there:,} of {packed:,} packed bytes')
    wanted = header.points * header.point_size
    if unpacked != wanted or unpacked > MOST_UNPACKED * packed:
        raise MapError(
            f'{where}: {packed:,} packed bytes should unpack to {unpacked:,}, and its header says '
            f'{header.points} points, which are {wanted:,}'
        )
    start = header.size + 8
    content = np.zeros(unpacked, dtype=np.uint8)
    written = _unpack_lzf(np.frombuffer(data, np.uint8, packed, start), content)
    if written != unpacked:
        raise MapError(f'{where}: its packed points are damaged')
    end = start + packed
    check_rest(data[end:], where)
    columns, place = {}, 0
    for one in header.fields:
        values = np.frombuffer(content, one.kind, header.points * one.count, place)
        columns[one.name] = values[:: one.count]
        place += values.nbytes
    return columns


def _ends(after: int, header: _Header, where: str) -> MapError:
    return MapError(f'{where}: ends after {after} of {header.points} points')


@kernel
def _unpack_lzf(packed, content):
    """
    Unpack LZF into `content` and return how many bytes that are; -1 where they do not fit.

    A control byte below 32 is followed by that many bytes and one more, as they are. Another one
    repeats what was written: its upper three bits (7: and the next byte) and two are the length,
    its lower five bits and the next byte how far back it begins.
    """
    read, written = 0, 0
    while read < packed.size:
        control = np.int64(packed[read])
        read += 1
        if control < 32:
            length = control + 1
            if read + length > packed.size or written + length > content.size:
                return -1
            for k in range(length):
                content[written + k] = packed[read + k]
            read += length
            written += length
            continue
        length = control >> 5
        if length == 7:
            if read >= packed.size:
                return -1
            length += np.int64(packed[read])
            read += 1
        if read >= packed.size:
            return -1
        back = written - ((control & 31) << 8) - np.int64(packed[read]) - 1
        read += 1
        length += 2
        if back < 0 or written + length > content.size:
            return -1
        for k in range(length):
            content[written + k] = content[back + k]
        written += length
    return written
