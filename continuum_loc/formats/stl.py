"""
STL, binary or ASCII.

A binary file says after 80 bytes how many triangles follow, of 50 bytes each; that number and the
size of the file decide what it is. The 80 bytes may begin with `solid` as an ASCII file does.
"""

from __future__ import annotations

import codecs
import re

from continuum_loc.errors import MapError
from continuum_loc.formats.numbers import table_of, text_of
from continuum_loc.formats.shapes import Mesh, mesh_of
import numpy as np

HEAD, TRIANGLE = 84, 50  # bytes
_RECORD = np.dtype([('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('attribute', '<u2')])
_FACET = ['facet', 'outer', 'vertex', 'vertex', 'vertex', 'endloop', 'endfacet']


def read_stl(data: bytes, where: str) -> Mesh:
    """Read a mesh; its vertices are the triangles' corners, three each. Raises MapError."""
    data = data.removeprefix(codecs.BOM_UTF8)
    count = int.from_bytes(data[80:HEAD], 'little')
    if len(data) >= HEAD and len(data) == HEAD + TRIANGLE * count:
        corners = np.frombuffer(data, _RECORD, count, HEAD)['corners'].reshape(-1, 3)
    elif re.match(rb'\s*solid\b', data, re.IGNORECASE) and b'\0' not in data:
        corners = _ascii(text_of(data, where), where)
    elif len(data) < HEAD:
        raise MapError(
            f'{where}: not an STL file: it neither begins with `solid` nor is it binary'
        )
    else:
        raise MapError(_wrong_size(len(data), count, where))
    if len(corners) == 0:
        raise MapError(f'{where}: holds no triangles')
    return mesh_of(corners, np.arange(len(corners)).reshape(-1, 3), [], where)


def _wrong_size(size: int, count: int, where: str) -> str:
    there = (size - HEAD) // TRIANGLE
    if there < count:
        return f'{where}: ends after {there} of {count} triangles'
    return (
        f'{where}: says {count} triangles, which are {HEAD + TRIANGLE * count:,} bytes, and has '
        f'{size:,}'
    )


def _ascii(text: str, where: str) -> np.ndarray:
    lines = text.split('\n')
    numbers = [k + 1 for k, line in enumerate(lines) if line.strip()]
    words = [lines[k - 1].split() for k in numbers]
    step, corners, on, inside = 0, [], [], False
    for number, line in zip(numbers, words, strict=True):
        first = line[0].lower()
        if step == 0 and first == ('endsolid' if inside else 'solid'):
            inside = not inside
        elif inside and first == _FACET[step]:
            if first == 'vertex':
                corners.append(' '.join(line[1:]))
                on.append(number)
            step = (step + 1) % len(_FACET)
        else:
            expected = _FACET[step] if inside else 'solid'
            raise MapError(
                f"{where}, line {number}: '{' '.join(line)[:80]}' where `{expected}` belongs"
            )
    if inside:
        raise MapError(
            f'{where}: ends after {len(corners) // 3} triangles without `endsolid`: it was cut'
        )
    return table_of(corners, on, ('x', 'y', 'z'), where)
