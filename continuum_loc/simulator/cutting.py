"""
Convex pieces of a large solid, by cutting it with planes.

A piece is done when its hull stands nowhere farther out than a tolerance; otherwise it is cut in
two, in the middle or along a face that the hull hides, whichever takes more of what the hull has
in excess. Cuts are exact, so thin blades stay thin, and the cost grows nearly with the number of
faces: CoACD, which searches for few pieces, takes minutes where this takes seconds.
"""

from __future__ import annotations

from collections.abc import Iterator

from continuum_loc.simulator.solids import mesh_of, solid_of, vertices_of
from manifold3d import Manifold
from numba import njit
import numpy as np

_TILE_FACES = 4000  # above this, a piece is halved without a look at its hull
_FACE_PREFERENCE = 0.1  # share of the excess that a cut along a face must save beyond a halving
_SHALLOW = 0.125  # share of the tolerance that a step may be high and pass for flat
_NO_AREA = 1e-12  # m^2
_SLIVER = 1e-4  # a cut that takes less than this share of the volume makes no progress
_FOIL = 1e-5  # thinner than this is what a cut leaves by rounding, and no piece of its own [m]


def tiles(vertices: np.ndarray, faces: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Meshes (vertices, faces) of a solid, halved until each has at most a few thousand faces."""
    waiting, done = [solid_of(vertices, faces)], []
    while waiting:
        solid = waiting.pop()
        if solid.num_tri() <= _TILE_FACES:
            done.append(mesh_of(solid))
            continue
        low, high = _box(solid)
        axis = int(np.argmax(high - low))
        waiting += _cut(solid, np.eye(3)[axis], (low + high)[axis] / 2.0)
    return done


def pieces(vertices: np.ndarray, faces: np.ndarray, tolerance: float) -> Iterator[np.ndarray]:
    """Vertices (n, 3) of convex pieces that stand out of a solid by at most about `tolerance`."""
    waiting = _parts(solid_of(vertices, faces))
    while waiting:
        solid = waiting.pop()
        hull = solid.hull()
        low, high = _box(solid)
        gap, normal, centre = _gaps(solid, hull, _SHALLOW * tolerance)
        halves = []
        if gap.max(initial=0.0) > tolerance and (high - low).max() > 2.0 * tolerance:
            # The longest edge first: it wins where halving saves nothing either way.
            planes = [(np.eye(3)[k], (low + high)[k] / 2.0, 0.0) for k in np.argsort(low - high)]
            hidden = np.flatnonzero(gap > tolerance)
            # Just before the face: exactly on it, a foil of the face would stay behind.
            planes += [
                (normal[face], normal[face] @ centre[face] + _FOIL, _FACE_PREFERENCE)
                for face in _different(normal, hidden[np.argsort(-gap[hidden])])
            ]
            halves = _best_cut(solid, hull, planes)
        if halves:
            waiting += [part for half in halves for part in _parts(half)]
        else:
            yield vertices_of(hull)


def _best_cut(
    solid: Manifold,
    hull: Manifold,
    planes: list[tuple[np.ndarray, float, float]],
) -> list[Manifold]:
    """
    Halve a solid so that most of its hull's excess is saved; no halves where no cut works.

    planes: unit normal, offset [m], share of the excess that it has to save beyond the others.
    """
    excess = hull.volume() - solid.volume()
    best, chosen = np.inf, []
    for direction, offset, handicap in planes:
        halves = _cut(solid, direction, offset)
        if min(half.volume() for half in halves) < _SLIVER * solid.volume():
            continue
        cost = sum(half.hull().volume() for half in halves) + handicap * excess
        if cost < (1.0 - 1e-6) * best:
            best, chosen = cost, halves
    return chosen


def _different(normal: np.ndarray, faces: np.ndarray, count: int = 2) -> list[int]:
    """Pick the first few of `faces` that look different ways."""
    chosen: list[int] = []
    for face in faces[:200]:
        if all(normal[face] @ normal[other] < 0.9 for other in chosen):
            chosen.append(int(face))
        if len(chosen) == count:
            break
    return chosen


def _parts(solid: Manifold) -> list[Manifold]:
    """Separate connected parts; a solid with a cavity (its boundary would be one) stays whole."""
    if solid.volume() <= _FOIL * solid.surface_area() / 2.0:
        return []
    parts = solid.decompose()
    if min(part.volume() for part in parts) < 0.0:
        return [solid]
    return [part for part in parts if part.volume() > _FOIL * part.surface_area() / 2.0]


def _cut(solid: Manifold, normal: np.ndarray, offset: float) -> list[Manifold]:
    return list(solid.split_by_plane(tuple(map(float, normal)), float(offset)))


def _box(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    bounds = np.array(solid.bounding_box())
    return bounds[:3], bounds[3:]


def _gaps(
    solid: Manifold, hull: Manifold, shallow: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each face of a solid: free way to its hull along the normal (F,) [m]; normal, centre."""
    normal, centre = _planes(solid)
    outward, support = _planes(hull)
    offset = np.einsum('ij,ij->i', outward, support)
    return _exits(normal, centre, outward, offset, shallow), normal, centre


def _planes(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit normals and centres (F, 3) of a solid's faces, but for slivers."""
    vertices, faces = mesh_of(solid)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    twice_area = np.linalg.norm(normal, axis=1)
    sound = twice_area > _NO_AREA
    return normal[sound] / twice_area[sound, None], ((a + b + c) / 3.0)[sound]


@njit(cache=True)
def _exits(normal, centre, outward, offset, shallow):
    """
    Distance (F,) from each centre along its normal to where it leaves the hull's half-spaces.

    0 for what lies less than `shallow` below the hull: the side of a small step looks far along
    the hull, which stands out by no more than the step is high.
    """
    exits = np.zeros(len(normal))
    for i in range(len(normal)):
        nearest, depth = np.inf, np.inf
        for j in range(len(outward)):
            ahead, left = 0.0, offset[j]
            for k in range(3):
                ahead += outward[j, k] * normal[i, k]
                left -= outward[j, k] * centre[i, k]
            depth = min(depth, left)
            if ahead > 1e-9:
                nearest = min(nearest, max(left, 0.0) / ahead)
        exits[i] = nearest if depth > shallow and nearest < np.inf else 0.0
    return exits
