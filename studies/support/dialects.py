"""Clouds and meshes written as other programs write them: what the readers are tried with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import struct

import numpy as np

PLY_TYPES = {'f4': 'float', 'f8': 'double', 'u1': 'uchar', 'i4': 'int', 'i2': 'short'}
PLY_FORMATS = {'ascii': '', 'binary_little_endian': '<', 'binary_big_endian': '>'}
Columns = Mapping[str, tuple[str, np.ndarray]]  # name -> type of NumPy, values (P,)


def xyz(points: np.ndarray, types: Sequence[str] = ('f4', 'f4', 'f4')) -> Columns:
    """Give points (P, 3) as named columns of these types."""
    return {
        name: (kind, points[:, k]) for k, (name, kind) in enumerate(zip('xyz', types, strict=True))
    }


def box(lower: Sequence[float], size: Sequence[float]) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices (8, 3) and the six sides of a box, counter-clockwise seen from outside."""
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    vertices = np.array(lower) + np.array(corners) * np.array(size)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return vertices.astype(np.float64), sides


def triangles(sides: Sequence[Sequence[int]]) -> list[list[int]]:
    """Cut polygons into fans from their first corners."""
    return [[s[0], s[k], s[k + 1]] for s in sides for k in range(1, len(s) - 1)]


def ply(
    columns: Columns,
    form: str = 'ascii',
    *,
    faces: Sequence[Sequence[int]] | None = None,
    newline: str = '\n',
    head: Sequence[str] = (),
    count: object = None,
) -> bytes:
    """
    Write a PLY file.

    faces: polygons. head: further lines of the header. count: said of the vertices in place of
    what they are.
    """
    length = len(next(iter(columns.values()))[1])
    lines = [
        'ply',
        f'format {form} 1.0',
        *head,
        f'element vertex {length if count is None else count}',
    ]
    lines += [f'property {PLY_TYPES[kind]} {name}' for name, (kind, _) in columns.items()]
    if faces is not None:
        lines += [f'element face {len(faces)}', 'property list uchar int vertex_indices']
    header = newline.join([*lines, 'end_header', '']).encode()
    if form == 'ascii':
        rows = [' '.join(_word(*cell) for cell in row) for row in _cells(columns)]
        rows += [' '.join(map(str, [len(face), *face])) for face in faces or ()]
        return header + newline.join([*rows, '']).encode()
    order = PLY_FORMATS[form]
    body = _table(columns, order).tobytes()
    body += b''.join(struct.pack(f'{order}B{len(f)}i', len(f), *f) for f in faces or ())
    return header + body


def pcd(
    columns: Columns,
    encoding: str = 'binary',
    *,
    width: int | None = None,
    newline: str = '\n',
    count: object = None,
    viewpoint: str = '0 0 0 1 0 0 0',
) -> bytes:
    """
    Write a PCD file of version 0.7; columns named `_` and a number are padding of that many bytes.

    width: of an organised cloud. count: said of the points in place of what they are.
    """
    length = len(next(iter(columns.values()))[1])
    width = length if width is None else width
    rows = length if count is None else count
    fields = [(name, kind) for name, (kind, _) in columns.items()]
    pads = {name: int(name[1:]) for name, _ in fields if name.startswith('_')}
    lines = [
        '# .PCD v0.7 - Point Cloud Data file format',
        'VERSION 0.7',
        f'FIELDS {" ".join("_" if name in pads else name for name, _ in fields)}',
        f'SIZE {" ".join(kind[1] for _, kind in fields)}',
        f'TYPE {" ".join(kind[0].upper() for _, kind in fields)}',
        f'COUNT {" ".join(str(pads.get(name, 1)) for name, _ in fields)}',
        f'WIDTH {width if count is None else count}',
        f'HEIGHT {length // max(width, 1) if count is None else 1}',
        f'VIEWPOINT {viewpoint}',
        f'POINTS {rows}',
        f'DATA {encoding}',
    ]
    header = newline.join([*lines, '']).encode()
    if encoding == 'ascii':
        body = [' '.join(_word(*cell) for cell in row) for row in _cells(columns, pads)]
        return header + newline.join([*body, '']).encode()
    table = _table(columns, '<', pads)
    if encoding == 'binary':
        return header + table.tobytes()
    apart = b''.join(np.ascontiguousarray(table[name]).tobytes() for name in table.dtype.names)
    packed = lzf(apart)
    return header + struct.pack('<II', len(packed), len(apart)) + packed


def text(
    columns: Mapping[str, np.ndarray],
    delimiter: str = ' ',
    *,
    header: str = '',
    newline: str = '\n',
    before: Sequence[str] = (),
    decimals: int = 4,
    comma: bool = False,
) -> str:
    """
    Write a table of text; columns of whole numbers without decimals.

    header: '' for none, or the names' form: `lower`, `upper`, `quoted`, `slashes`, `hash`. before:
    lines before it. comma: whether the decimal point is a comma.
    """
    forms = {
        'lower': delimiter.join(columns),
        'upper': delimiter.join(columns).upper(),
        'quoted': delimiter.join(f'"{name}"' for name in columns),
        'slashes': '//' + delimiter.join(columns).upper(),
        'hash': '# ' + delimiter.join(columns),
    }
    lines = [*before] + ([forms[header]] if header else [])
    for row in zip(*columns.values(), strict=True):
        words = [
            str(value) if isinstance(value, np.integer) else f'{value:.{decimals}f}'
            for value in row
        ]
        line = delimiter.join(words)
        lines.append(line if not comma else delimiter.join(w.replace('.', ',') for w in words))
    return newline.join([*lines, ''])


def stl(corners: np.ndarray, head: bytes = b'binary', count: int | None = None) -> bytes:
    """Write a binary STL of triangles (F, 3, 3); count: said in place of what they are."""
    said = len(corners) if count is None else count
    body = b''.join(
        struct.pack('<12fH', 0.0, 0.0, 0.0, *triangle.ravel(), 0) for triangle in corners
    )
    return head.ljust(80)[:80] + struct.pack('<I', said) + body


def ascii_stl(corners: np.ndarray) -> str:
    """Write an ASCII STL of triangles (F, 3, 3)."""
    lines = ['solid part']
    for triangle in corners:
        lines += ['facet normal 0 0 0', '  outer loop']
        lines += [f'    vertex {x:.4f} {y:.4f} {z:.4f}' for x, y, z in triangle]
        lines += ['  endloop', 'endfacet']
    return '\n'.join([*lines, 'endsolid part', ''])


def obj(
    vertices: np.ndarray,
    faces: Sequence[Sequence[int]],
    *,
    relative: bool = False,
    slash: str = '',
) -> str:
    """
    Write an OBJ of polygons that count from 0.

    relative: whether indices are negative. slash: what follows each.
    """
    shift = -len(vertices) if relative else 1
    lines = [f'v {x:.4f} {y:.4f} {z:.4f}' for x, y, z in vertices]
    lines += ['f ' + ' '.join(f'{index + shift}{slash}' for index in face) for face in faces]
    return '\n'.join([*lines, ''])


def lzf(data: bytes) -> bytes:
    """Pack by LZF, with references to what went before wherever three bytes are alike."""
    packed, literals, seen, place = bytearray(), bytearray(), {}, 0
    while place < len(data):
        end = place + 3
        key = data[place:end]
        back = place - seen.get(key, -1) - 1
        known = len(key) == 3 and key in seen and back < 8192
        seen[key] = place
        if not known:
            literals.append(data[place])
            place += 1
            if len(literals) == 32:
                _flush(literals, packed)
            continue
        length = 3
        while (
            place + length < len(data)
            and length < 264
            and (data[place + length] == data[place + length - back - 1])
        ):
            length += 1
        _flush(literals, packed)
        short = length - 2
        packed.append((min(short, 7) << 5) | (back >> 8))
        if short >= 7:
            packed.append(short - 7)
        packed.append(back & 255)
        place += length
    _flush(literals, packed)
    return bytes(packed)


def _flush(literals: bytearray, packed: bytearray) -> None:
    if literals:
        packed.append(len(literals) - 1)
        packed += literals
        literals.clear()


def _table(columns: Columns, order: str, pads: Mapping[str, int] | None = None) -> np.ndarray:
    pads = pads or {}
    kinds = [
        (name, order + kind, (pads[name],)) if name in pads else (name, order + kind)
        for name, (kind, _) in columns.items()
    ]
    table = np.zeros(len(next(iter(columns.values()))[1]), dtype=kinds)
    for name, (_, values) in columns.items():
        if name not in pads:
            table[name] = values
    return table


def _cells(columns: Columns, pads: Mapping[str, int] | None = None) -> list[list[tuple]]:
    pads = pads or {}
    length = len(next(iter(columns.values()))[1])
    return [
        [
            (kind, 0 if name in pads else values[row])
            for name, (kind, values) in columns.items()
            for _ in range(pads.get(name, 1))
        ]
        for row in range(length)
    ]


def _word(kind: str, value: float) -> str:
    return f'{value:.4f}' if kind[0] == 'f' else str(int(value))
