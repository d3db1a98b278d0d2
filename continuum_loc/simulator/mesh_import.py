"""Scenes from a mesh that a user brings: checked, and cut into convex pieces for contact."""

from __future__ import annotations

from pathlib import Path

from continuum_loc.errors import MapError, SceneError
from continuum_loc.extras import require
from continuum_loc.formats.reading import read_shape
from continuum_loc.formats.shapes import Cloud
from continuum_loc.simulator.convex import convex_pieces
from continuum_loc.simulator.scene import Scene
from continuum_loc.simulator.scene_cache import cached_scene
import numpy as np

_SMALLEST, _LARGEST = 0.05, 50.0  # a continuum robot's surroundings, longest edge [m]
_REFLECTANCE = 0.5
_EXPORT = (
    'export a triangle mesh, not points or curves, and name the file by what it is (.stl, .obj, '
    '.ply)'
)
_WALL = 0.05  # thickness given to a room that is modelled by its inner surface alone [m]


def import_mesh(path: Path) -> Scene:
    """
    Import a scene from an STL, OBJ or PLY file in metres and the map frame. Raises SceneError.

    The mesh is either a solid (faces counter-clockwise seen from outside), or the inner surface of
    a room (faces counter-clockwise seen from inside).
    """
    mesh = _load(path)
    check_mesh(mesh.vertices, mesh.faces, str(path))
    return cached_scene(
        path.stem, __name__, lambda: _scene(path, mesh.vertices, mesh.faces), made_from=[path]
    )


def check_mesh(vertices: np.ndarray, faces: np.ndarray, where: str) -> None:
    """Raise SceneError unless a mesh is closed, oriented, without bad faces, of a likely size."""
    if len(faces) == 0:
        raise SceneError(f'{where}: no faces; {_EXPORT}')
    if not np.all(np.isfinite(vertices)):
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise SceneError(
            f'{where}: vertex {bad} is {vertices[bad]}; every coordinate must be finite'
        )
    _check_size(vertices[np.unique(faces)], where)
    _check_degenerate(vertices, faces, where)
    _check_closed(vertices, faces, where)


def _load(path: Path):
    trimesh = require('trimesh', 'simulate')

    if path.is_dir():
        raise SceneError(f'{path}: a folder, not a mesh file')
    try:
        read = read_shape(path)
    except MapError as error:
        raise SceneError(str(error)) from None
    if isinstance(read, Cloud):
        raise SceneError(f'{path}: no faces; {_EXPORT}')
    mesh = trimesh.Trimesh(read.vertices, read.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # STL repeats vertices per face
    return mesh


def _check_size(vertices: np.ndarray, where: str) -> None:
    extent = np.ptp(vertices, axis=0)
    longest = float(extent.max())
    if _SMALLEST <= longest <= _LARGEST:
        return
    hint = (
        '; its units look like millimetres: scale it by 0.001'
        if _SMALLEST <= longest / 1000.0 <= _LARGEST
        else ''
    )
    raise SceneError(
        f'{where}: measures {" x ".join(f"{edge:.4g}" for edge in extent)} m{hint}. '
        f'The longest edge must lie between {_SMALLEST} and {_LARGEST} m'
    )


def _check_degenerate(vertices: np.ndarray, faces: np.ndarray, where: str) -> None:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    longest = np.maximum.reduce([np.sum(d**2, axis=1) for d in (b - a, c - b, a - c)])
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 1e-9 * longest
    if flat.any():
        first = int(np.flatnonzero(flat)[0])
        raise SceneError(
            f'{where}: {int(flat.sum())} degenerate faces without area, the first is face {first} '
            f'at {_place(a[first])}; remove them (MeshLab: Remove Zero Area Faces)'
        )


def _check_closed(vertices: np.ndarray, faces: np.ndarray, where: str) -> None:
    """Each directed edge must be met by its reverse, once."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(
        np.int64
    )
    edges, index, count = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    if (count == 1).any():
        middle = vertices[edges[count == 1]].mean(axis=(0, 1))
        raise SceneError(
            f'{where}: {int((count == 1).sum())} open edges, holes near {_place(middle)}; '
            'close them (MeshLab: Close Holes; Blender: Mesh > Clean Up > Fill Holes)'
        )
    if (count > 2).any():
        place = vertices[edges[count > 2][0]].mean(axis=0)
        raise SceneError(
            f'{where}: {int((count > 2).sum())} edges join more than two faces, the first near '
            f'{_place(place)}; separate or unite the bodies that meet there'
        )
    forward = np.bincount(
        index.ravel(), weights=np.where(directed[:, 0] < directed[:, 1], 1.0, -1.0)
    )
    if np.any(forward != 0.0):
        raise SceneError(
            f'{where}: {int((forward != 0.0).sum())} edges between faces that look opposite ways; '
            'make the orientation consistent (MeshLab: Re-Orient All Faces Coherently)'
        )


def _scene(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Scene:
    vertices = np.array(vertices, dtype=np.float64)
    faces = np.array(faces, dtype=np.int32)
    hulls = convex_pieces(*with_walls(vertices, faces), str(path))
    owner = np.zeros(len(faces), dtype=np.int32)
    return Scene(
        path.stem, vertices, faces, owner, (path.stem,), np.full(len(faces), _REFLECTANCE), hulls
    )


def with_walls(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give a solid as it is; the inner surface of a room as the walls round it."""
    if _volume(vertices, faces) > 0.0:
        return vertices, faces
    from continuum_loc.simulator.solids import mesh_of, solid_of
    from manifold3d import Manifold

    low, high = vertices.min(axis=0) - _WALL, vertices.max(axis=0) + _WALL
    block = Manifold.cube(tuple(high - low)).translate(tuple(low))
    return mesh_of(block - solid_of(vertices, faces[:, ::-1]))


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum('ij,ij->', np.cross(a, b), c)) / 6.0


def _place(point: np.ndarray) -> str:
    return f'({", ".join(f"{value:.3f}" for value in point)})'
