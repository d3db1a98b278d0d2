"""
OBJ (Wavefront): vertices and faces; materials, groups and the like say nothing of the shape.

An index counts from 1; a negative one from the vertex before the face backwards.
"""

from __future__ import annotations

import re

from continuum_loc.errors import MapError
from continuum_loc.formats.numbers import (
    cut_error,
    index_may_be_cut,
    may_be_cut,
    table_of,
    text_of,
)
from continuum_loc.formats.shapes import check_finite, doubled, Mesh, mesh_of, triangles_of
import numpy as np

_PROMISE = re.compile(r'#.*\b(vertices|faces|triangles)\s*:\s*(\d+)\s*$', re.IGNORECASE)
WIDTHS = {3: '', 4: 'w', 6: 'rgb', 7: 'wrgb'}  # numbers of a vertex, and what follows x y z
_SHAPE_WITHOUT_FACES = ('curv', 'curv2', 'surf', 'l', 'p')


def read_obj(data: bytes, where: str) -> Mesh:
    """Read a mesh; polygons are cut into triangles. Raises MapError with the line."""
    text = text_of(data, where)
    if '\\\n' in text:  # a line that goes on in the next; blank lines keep the numbers right
        text = re.sub(r'((?:[^\n]*\\\n)+)([^\n]*)', _joined, text)
    vertices, on, sizes, corners, other = [], [], [], [], set()
    lines = text.split('\n')
    for number, line in enumerate(lines, start=1):
        content = line.split('#', 1)[0] if '#' in line else line
        words = content.split()
        if not words:
            continue
        if words[0] == 'v':
            vertices.append(content)
            on.append(number)
        elif words[0] == 'f':
            face = [_index(word, len(vertices), f'{where}, line {number}') for word in words[1:]]
            if len(face) < 3:
                raise MapError(f'{where}, line {number}: a face of {len(face)} corners')
            sizes.append(len(face))
            corners += face
        else:
            other.add(words[0])
    if not sizes:
        raise MapError(f'{where}: holds no faces; a cloud of points can be read as PLY or XYZ')
    points, notes = _vertices(vertices, on, where)
    indices = np.array(corners)
    _check_indices(indices, np.array(sizes), len(points), lines, where)
    _check_end(lines, vertices, sizes, where)
    _check_promises(lines, {'vertices': len(points), 'faces': len(sizes)}, where)
    faces, cut = triangles_of(np.array(sizes), indices)
    unused = len(points) - len(np.unique(indices))
    notes += [f'{unused} of {len(points)} vertices belong to no face'] if unused else []
    unread = sorted(other.intersection(_SHAPE_WITHOUT_FACES))
    notes += [f'left aside: its lines `{"`, `".join(unread)}`'] if unread else []
    return mesh_of(points, faces, notes + cut, where)


def _joined(found: re.Match) -> str:
    return found[0].replace('\\\n', ' ') + '\n' * found[0].count('\\\n')


def _index(word: str, before: int, where: str) -> int:
    """Vertex from 0 of a corner `vertex`, `vertex/texture`, `vertex//normal` or all three."""
    text = word.split('/', 1)[0]
    try:
        index = int(text)
    except ValueError:
        index = 0
    if index == 0 or (index < 0 and before + index < 0):
        raise MapError(
            f"{where}: '{word[:40]}' names no vertex; they count from 1, or backwards from -1; "
            f'{before} come before this face'
        )
    return index - 1 if index > 0 else before + index


def _vertices(lines: list[str], on: list[int], where: str) -> tuple[np.ndarray, list[str]]:
    width = len(lines[0].split()) - 1 if lines else 3
    if width not in WIDTHS:
        raise MapError(
            f'{where}, line {on[0]}: a vertex of {width} numbers; valid are x y z, w, and a colour'
        )
    names = [*'xyz', *WIDTHS[width]]
    table = table_of([line.split('v', 1)[1] for line in lines], on, names, where)
    check_finite(table[:, :3], 'vertices', where, lambda row: f'line {on[row]}')
    if 'w' in names and (table[:, 3] != 1.0).any():
        raise MapError(f'{where}: its vertices have weights (w) other than 1')
    return table[:, :3], ['colours left aside'] if 'rgb' in WIDTHS[width] else []


def _check_indices(indices, sizes, count, lines, where) -> None:
    missing = np.flatnonzero(indices >= count)
    if len(missing):
        face = int(np.searchsorted(np.cumsum(sizes), missing[0], side='right'))
        numbers = [number for number, line in enumerate(lines, 1) if line.split()[:1] == ['f']]
        raise MapError(
            f'{where}, line {numbers[face]}: a face names vertex {indices[missing[0]] + 1}, there '
            f'are {count}'
        )


def _check_end(lines: list[str], vertices: list[str], sizes: list[int], where: str) -> None:
    """Refuse a last line without a break that may lack digits or corners."""
    words = lines[-1].split()
    if not words:
        return
    if words[0] == 'f':
        open_number = not lines[-1][-1].isspace() and index_may_be_cut(words[-1], len(vertices))
        cut = open_number or sizes[-1] < max(sizes)
    else:
        cut = words[0] == 'v' and may_be_cut(vertices)
    if cut:
        raise cut_error(where, len(lines))


def _check_promises(lines: list[str], there: dict[str, int], where: str) -> None:
    """Compare with the counts that MeshLab and Open3D write as comments, once for each kind."""
    found = [match for line in lines if line[:1] == '#' and (match := _PROMISE.match(line))]
    promised = [(match[1].lower().replace('triangles', 'faces'), int(match[2])) for match in found]
    often = doubled(kind for kind, _ in promised)
    for kind, count in promised:
        if kind not in often and count != there[kind]:
            raise MapError(f'{where}: says {count} {kind}, and holds {there[kind]}')
