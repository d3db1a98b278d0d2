"""Meshes in STL, PLY and OBJ: dialects that are to be read, and faults that are to be told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

from continuum_loc.formats.shapes import Mesh
import numpy as np
from studies._input_case import ANYTHING, Case, EITHER, READ, REFUSED
from studies._input_files import DECIMALS, DOUBLES, file_case, flipped, PLY_FORMS
from studies.support import dialects
from studies.support.dialects import xyz


def mesh_cases(seed: int) -> Iterator[Case]:
    """All meshes."""
    rng = np.random.default_rng(seed)
    yield from _meshes(rng)
    yield from _mesh_faults(rng)


def _solid(rng: np.random.Generator) -> tuple[np.ndarray, list[list[int]]]:
    """Three boxes, 1 m wide and 2 m apart, moved by whole millimetres."""
    shift = rng.integers(-500, 500, 3) * 1e-3
    boxes = [dialects.box(shift + [2.0 * k, 0.0, 0.0], [1.0, 1.0, 1.0]) for k in range(3)]
    vertices = np.concatenate([one for one, _ in boxes]).round(DECIMALS)
    sides = [[c + 8 * k for c in side] for k, (_, faces) in enumerate(boxes) for side in faces]
    return vertices, sides


def _same_mesh(corners: np.ndarray, few: bool = False) -> Callable[[Mesh], str]:
    """Judge a mesh: these triangles (F, 3, 3) in their order, or with `few` the first of them."""

    def judge(mesh: Mesh) -> str:
        expected = corners[: len(mesh.faces)] if few else corners
        read = mesh.vertices[mesh.faces]
        if read.shape != expected.shape:
            return f'{len(read)} triangles in place of {len(corners)}'
        off = np.abs(read - expected).max(initial=0.0)
        return f'corners off by {off:.3g}' if off > 0.0 else ''

    return judge


def _written_meshes(
    rng: np.random.Generator,
) -> Iterator[tuple[str, str, bytes, np.ndarray, bool]]:
    """(name, suffix, content, its triangles, whether the file says how many)."""
    vertices, sides = _solid(rng)
    triangles = dialects.triangles(sides)
    corners = vertices[np.array(triangles)]
    single = corners.astype(np.float32).astype(np.float64)
    yield 'STL', 'stl', dialects.stl(corners), single, True
    yield 'STL, head solid', 'STL', dialects.stl(corners, b'solid of steel'), single, True
    yield 'STL ascii', 'stl', dialects.ascii_stl(corners).encode(), corners, True
    for form, faces in product(PLY_FORMS, (sides, triangles)):
        data = dialects.ply(xyz(vertices, DOUBLES), form, faces=faces)
        yield f'PLY {form}, {len(faces[0])} corners', 'ply', data, corners, True
    for relative, slash, faces in product((False, True), ('', '/1', '//1'), (sides, triangles)):
        if relative:  # each box followed by its own faces
            parts = ((vertices[range(k, k + 8)], _part(faces, k)) for k in (0, 8, 16))
            text = ''.join(dialects.obj(*part, relative=True, slash=slash) for part in parts)
        else:
            text = dialects.obj(vertices, faces, slash=slash)
        name = f'OBJ, {len(faces[0])} corners, relative {relative}, slash {slash or "none"}'
        yield name, 'obj', text.encode(), corners, False


def _part(faces: list[list[int]], first: int) -> list[list[int]]:
    return [[c - first for c in face] for face in faces if first <= face[0] < first + 8]


def _meshes(rng: np.random.Generator) -> Iterator[Case]:
    for name, suffix, data, corners, _ in _written_meshes(rng):
        yield file_case('mesh', name, f'part.{suffix}', data, READ, _same_mesh(corners))
        if suffix == 'obj':
            data = data.replace(b'\n', b'\r\n')
            yield file_case('mesh', f'{name}, CRLF', 'part.obj', data, READ, _same_mesh(corners))


def _mesh_faults(rng: np.random.Generator) -> Iterator[Case]:
    for name, suffix, data, corners, counted in _written_meshes(rng):
        for cut in rng.integers(0, len(data), 2):
            judge = _same_mesh(corners, few=not counted)
            yield file_case(
                'mesh', f'{name}, cut at byte {cut}', f'cut.{suffix}', data[:cut], EITHER, judge
            )
        damaged = flipped(data, rng)
        yield file_case('mesh', f'{name}, bytes changed', f'flipped.{suffix}', damaged, ANYTHING)
    vertices, sides = dialects.box([0, 0, 0], [1, 1, 1])
    corners = vertices[np.array(dialects.triangles(sides))]
    for count in (11, 13, 2**32 - 1):
        data = dialects.stl(corners, count=count)
        yield file_case('mesh', f'STL says {count} triangles', 'lying.stl', data, REFUSED)
    whole = dialects.obj(vertices, sides)
    for name, text in {
        'a missing vertex': whole + 'f 1 2 9\n',
        'vertex 0': whole + 'f 0 1 2\n',
        'a vertex before the first': whole + 'f -9 -1 -2\n',
        'a face of two': whole + 'f 1 2\n',
        'a vertex of two': 'v 1 2\n' + whole,
        'a decimal comma': whole.replace('0.0000', '0,0000', 1),
        'a vertex that is not finite': whole.replace('0.0000', 'nan', 1),
        'no faces': dialects.obj(vertices, []),
        'fewer faces than its comments say': f'# Faces: 7\n{whole}',
        'a weight': 'v 0 0 0 2\nv 1 0 0 2\nv 0 1 0 2\nf 1 2 3\n',
    }.items():
        yield file_case('mesh', f'OBJ: {name}', 'bad.obj', text, REFUSED)
    for name, faces in {'a missing vertex': [[0, 1, 8]], 'a face of two': [[0, 1]]}.items():
        for form in PLY_FORMS:
            data = dialects.ply(xyz(vertices), form, faces=faces)
            yield file_case('mesh', f'PLY {form}: {name}', 'bad.ply', data, REFUSED)
