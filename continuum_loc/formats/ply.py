"""
PLY, ASCII or binary of either byte order: clouds, and meshes of polygons.

The header says what follows: elements, each with a count and properties, and a list property with
a count of its own per row. Every promise is compared with the bytes that are there.
"""

from __future__ import annotations

import codecs
from dataclasses import dataclass, field
import re

from continuum_loc.errors import MapError
from continuum_loc.formats.numbers import (
    cut_error,
    index_may_be_cut,
    may_be_cut,
    table_of,
    text_of,
)
from continuum_loc.formats.shapes import (
    canonical,
    check_rest,
    Cloud,
    cloud_of,
    doubled,
    Mesh,
    mesh_of,
    require_columns,
    triangles_of,
    USED,
)
import numpy as np

LONGEST_HEADER = 1_000_000  # bytes; scanners write some thousand
CORNERS = ('vertex_indices', 'vertex_index')
_TYPES = {
    'char': 'i1',
    'uchar': 'u1',
    'short': 'i2',
    'ushort': 'u2',
    'int': 'i4',
    'uint': 'u4',
    'float': 'f4',
    'double': 'f8',
    **{f'{word}{8 * size}': f'{word[0]}{size}' for word in ('int', 'uint') for size in (1, 2, 4)},
    'float32': 'f4',
    'float64': 'f8',
}
_ORDER = {'binary_little_endian': '<', 'binary_big_endian': '>', 'ascii': ''}


@dataclass
class _Property:
    name: str
    type: str  # of NumPy, without byte order
    length: str | None = None  # type of a list's count; None for a plain number


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def is_plain(self) -> bool:
        return all(one.length is None for one in self.properties)


@dataclass
class _Header:
    order: str  # of NumPy; empty for ASCII
    elements: list[_Element]
    size: int  # bytes
    lines: int  # of text, its last one among them


@dataclass
class _Rows:
    """Values of an element: plain properties (N,), and of each list its sizes and its content."""

    columns: dict[str, np.ndarray]
    lists: dict[str, tuple[np.ndarray, np.ndarray]]


def read_ply(data: bytes, where: str) -> Cloud | Mesh:
    """Read a cloud, or a mesh where there are faces. Raises MapError."""
    data = data.removeprefix(codecs.BOM_UTF8)
    header = _header(data, where)
    named = {element.name: element for element in header.elements}
    if 'vertex' not in named:
        raise MapError(f'{where}: has no element vertex; it has {", ".join(named) or "none"}')
    plain = [canonical(one.name) for one in named['vertex'].properties if one.length is None]
    require_columns(plain, where)
    read = _ascii if header.order == '' else _binary
    rows = read(data, header, where)
    vertex = rows['vertex'].columns
    others = [name for name, element in named.items() if name != 'vertex' and element.count]
    if 'face' in others:
        return _mesh(vertex, rows['face'], where)
    columns = {canonical(name): values for name, values in vertex.items()}
    cloud = cloud_of(columns, where)
    notes = (f'elements left aside: {", ".join(others)}',) if others else ()
    return Cloud(cloud.points, cloud.normals, cloud.planarity, cloud.notes + notes)


def _mesh(vertex: dict, faces: _Rows, where: str) -> Mesh:
    name = next((name for name in CORNERS if name in faces.lists), None)
    if name is None:
        raise MapError(f'{where}: its faces have no {" or ".join(CORNERS)}')
    sizes, corners = faces.lists[name]
    few = np.flatnonzero(sizes < 3)
    if len(few):
        raise MapError(f'{where}: face {few[0]} (counted from 0) has {sizes[few[0]]} corners')
    triangles, notes = triangles_of(sizes, corners.astype(np.int64))
    by_name = {canonical(key): values for key, values in vertex.items()}
    vertices = np.column_stack([by_name[axis] for axis in 'xyz'])
    return mesh_of(vertices, triangles, notes, where)


# Header


def _header(data: bytes, where: str) -> _Header:
    old = re.match(rb'ply[ \t]*\r(?!\n)', data)  # lines of an old Macintosh end with CR alone
    end = re.search(
        rb'(?<=\r)end_header[ \t]*\r' if old else rb'(?<=\n)end_header[ \t]*\r?\n',
        data[:LONGEST_HEADER],
    )
    if not data.startswith(b'ply') or end is None:
        raise MapError(f'{where}: not a PLY file: it does not begin with ply ... end_header')
    lines = text_of(data[: end.start()], where).split('\n')
    order, elements = None, []
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words or words[0] in ('comment', 'obj_info'):
            continue
        try:
            order = _take(words, order, elements)
        except (ValueError, KeyError, IndexError) as error:
            raise MapError(
                f"{where}, line {number}: '{line[:80]}' in the header of a PLY file ({error})"
            ) from None
    if order is None:
        raise MapError(f'{where}: no line `format` in its header')
    _check_elements(elements, where)
    return _Header(order, elements, end.end(), len(lines))


def _take(words: list[str], order: str | None, elements: list[_Element]) -> str | None:
    """Take in one line of the header. Raises ValueError, KeyError or IndexError for a bad one."""
    match words:
        case ['format', name, '1.0'] if order is None:
            return _ORDER[name]
        case ['element', name, count] if re.fullmatch(r'\d{1,20}', count):
            elements.append(_Element(name, int(count)))
        case ['property', 'list', length, kind, name] if _TYPES[length][0] != 'f':
            elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
        case ['property', kind, name]:
            elements[-1].properties.append(_Property(name, _TYPES[kind]))
        case _:
            raise ValueError('unknown')
    return order


def _check_elements(elements: list[_Element], where: str) -> None:
    lists = [[element.name for element in elements]]
    lists += [[canonical(one.name) for one in element.properties] for element in elements]
    for names in lists:
        if twice := doubled(names):
            raise MapError(f'{where}: its header names {", ".join(twice)} twice')
    empty = [element.name for element in elements if not element.properties and element.count]
    if empty:
        raise MapError(f'{where}: element {empty[0]} has no property')


# Binary


def _binary(data: bytes, header: _Header, where: str) -> dict[str, _Rows]:
    rows, place = {}, header.size
    for element in header.elements:
        read = _plain_rows if element.is_plain else _list_rows
        rows[element.name], place = read(data, place, element, header.order, where)
    check_rest(data[place:], where)
    return rows


def _plain_rows(data, place, element, order, where):
    kind = np.dtype([(one.name, order + one.type) for one in element.properties])
    _check_room(len(data) - place, element, kind.itemsize, where)
    table = np.frombuffer(data, kind, element.count, place)
    return _Rows({name: table[name] for name in kind.names or ()}, {}), (
        place + element.count * kind.itemsize
    )


def _check_room(room: int, element: _Element, size: int, where: str) -> None:
    if element.count * size > room:
        raise _ends(element, room // size, where)


def _ends(element: _Element, after: int, where: str) -> MapError:
    things = {'vertex': 'points', 'face': 'faces'}.get(element.name, f'rows of {element.name}')
    return MapError(f'{where}: ends after {after} of {element.count} {things}')


def _list_rows(data, place, element, order, where):
    least = sum(np.dtype(one.length or one.type).itemsize for one in element.properties)
    _check_room(len(data) - place, element, least, where)
    even = _even_rows(data, place, element, order)
    return even or _uneven_rows(data, place, element, order, where)


def _even_rows(data, place, element, order):
    """Read rows whose lists are as long as the first one's, as in most meshes; else None."""
    if element.count == 0:
        return _gathered([], element), place
    first, _ = _one_row(data, place, element.properties, order)
    if first is None:
        return None
    parts = []
    for one in element.properties:
        if one.length is None:
            parts.append((one.name, order + one.type))
        else:
            parts.append((f'# {one.name}', order + one.length))
            parts.append((one.name, order + one.type, (len(first[one.name]),)))
    kind = np.dtype(parts)
    if element.count * kind.itemsize > len(data) - place:
        return None
    table = np.frombuffer(data, kind, element.count, place)
    lists = {one.name: len(first[one.name]) for one in element.properties if one.length}
    if any((table[f'# {name}'] != size).any() for name, size in lists.items()):
        return None
    return _Rows(
        {one.name: table[one.name] for one in element.properties if one.length is None},
        {
            name: (np.full(element.count, size), table[name].reshape(-1))
            for name, size in lists.items()
        },
    ), place + element.count * kind.itemsize


def _uneven_rows(data, place, element, order, where):
    rows = []
    for number in range(element.count):
        row, place = _one_row(data, place, element.properties, order)
        if row is None:
            raise _ends(element, number, where)
        rows.append(row)
    return _gathered(rows, element), place


def _one_row(data, place, properties, order):
    """One row from byte `place` on, and the place behind it; None where the data end within."""
    row = {}
    for one in properties:
        count = 1
        if one.length is not None:
            size = np.dtype(one.length).itemsize
            if place + size > len(data):
                return None, place
            count = int(np.frombuffer(data, order + one.length, 1, place)[0])
            place += size
        size = count * np.dtype(one.type).itemsize
        if count < 0 or place + size > len(data):
            return None, place
        row[one.name] = np.frombuffer(data, order + one.type, count, place)
        place += size
    return row, place


def _gathered(rows: list[dict], element: _Element) -> _Rows:
    columns, lists = {}, {}
    for one in element.properties:
        values = [row[one.name] for row in rows]
        joined = np.concatenate(values) if values else np.empty(0)
        if one.length is None:
            columns[one.name] = joined
        else:
            lists[one.name] = np.array([len(value) for value in values], dtype=np.int64), joined
    return _Rows(columns, lists)


# ASCII


def _ascii(data: bytes, header: _Header, where: str) -> dict[str, _Rows]:
    body_start = header.size
    text = text_of(data[body_start:], where)
    lines = text.split('\n')
    numbers = [k for k, line in enumerate(lines) if line.strip()]
    rows, start = {}, 0
    for element in header.elements:
        end = start + element.count
        mine = numbers[start:end]
        if len(mine) < element.count:
            raise _ends(element, len(mine), where)
        start = end
        body = [lines[k] for k in mine]
        on = [header.lines + 1 + k for k in mine]
        read = _ascii_plain if element.is_plain else _ascii_lists
        rows[element.name] = read(body, on, element, where)
        if start == len(numbers) and body and not text.endswith('\n'):
            _check_end(body, on[-1], element, header, where)
    if start < len(numbers):
        raise MapError(
            f'{where}, line {header.lines + 1 + numbers[start]}: goes on after the rows that its '
            'header says'
        )
    return rows


def _ascii_plain(body, on, element, where):
    names = [one.name for one in element.properties]
    table = table_of(body, on, names, where)
    return _Rows(dict(zip(names, table.T, strict=True)), {})


def _ascii_lists(body, on, element, where):
    rows = []
    for line, number in zip(body, on, strict=True):
        row = _ascii_row(line.split(), element.properties)
        if row is None:
            raise MapError(
                f"{where}, line {number}: '{line.strip()[:80]}' is no {element.name}: expected "
                f'{", ".join(_said(one) for one in element.properties)}'
            )
        rows.append(row)
    return _gathered(rows, element)


def _said(one: _Property) -> str:
    return one.name if one.length is None else f'a count and so many {one.name}'


def _ascii_row(words: list[str], properties: list[_Property]) -> dict | None:
    row, place = {}, 0
    try:
        for one in properties:
            count = 1
            if one.length is not None:
                count = int(words[place])
                place += 1
            end = place + count
            given = words[place:end]
            if count < 0 or len(given) < count:
                return None
            row[one.name] = np.array([(float if one.type[0] == 'f' else int)(w) for w in given])
            place = end
    except (ValueError, IndexError):
        return None
    return row if place == len(words) else None


def _check_end(body, number, element, header, where) -> None:
    """Refuse a last number that may lack digits, where it is one that is used."""
    last = element.properties[-1]
    if last.length is not None:
        points = next(one.count for one in header.elements if one.name == 'vertex')
        cut = last.name in CORNERS and index_may_be_cut(body[-1].split()[-1], points - 1)
    else:
        used = element.name == 'vertex' and canonical(last.name) in USED
        cut = used and may_be_cut(body)
    if cut:
        raise cut_error(where, number)
