"""
Convex pieces of a large solid, by cutting it with planes.

A piece is done when no point of its hull is farther from it than a tolerance; otherwise it is cut
in two, in the middle or along a face that the hull hides, whichever takes more of what the hull
has in excess. Cuts are exact, so thin blades stay thin, and the cost grows nearly with the number
of faces: CoACD, which searches for few pieces, takes minutes where this takes seconds.
"""

from __future__ import annotations

from collections.abc import Iterator

from continuum_loc.compiling import kernel
from continuum_loc.simulator.solids import mesh_of, solid_of, vertices_of
from manifold3d import Manifold
import numpy as np

_TILE_FACES = 4000  # above this, a piece is halved without a look at its hull
_FACE_PREFERENCE = 0.1  # share of the excess that a cut along a face must save beyond a halving
_SHORT_PREFERENCE = 0.05  # the same of a halving across another edge than the longest
_BEYOND = 1.02  # tolerances before a hidden face: there its hull has to be near something else
_FINEST = 0.125  # share of the tolerance below which a triangle is judged by its corners alone
_NO_AREA = 1e-12  # m^2
_SLIVER = 1e-4  # a cut that takes less than this share of the volume has to save much
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
    """Vertices (n, 3) of convex pieces that stand out of a solid by at most `tolerance` [m]."""
    waiting = _parts(solid_of(vertices, faces))
    while waiting:
        solid = waiting.pop()
        hull = solid.hull()
        low, high = _box(solid)
        gap, normal, centre = _gaps(solid, hull)
        hidden = np.flatnonzero(gap > tolerance)
        before = centre[hidden] + _BEYOND * tolerance * normal[hidden]
        halves = []
        if (high - low).max() > 2.0 * tolerance and not _within(hull, solid, before, tolerance):
            planes = _halvings(low, high, tolerance)
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


def _halvings(
    low: np.ndarray, high: np.ndarray, tolerance: float
) -> list[tuple[np.ndarray, float, float]]:
    """
    Planes across the middles of a box's edges, the longest edge first.

    None leaves slices thinner than the tolerance: one such halving after another can save a
    little each time, and end in a pile of foils that are as far from convex as their whole.
    """
    longest, *shorter = np.argsort(low - high)
    middle = (low + high) / 2.0
    return [(np.eye(3)[longest], middle[longest], 0.0)] + [
        (np.eye(3)[k], middle[k], _SHORT_PREFERENCE)
        for k in shorter
        if high[k] - low[k] > 2.0 * tolerance
    ]


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
        left = sum(half.hull().volume() for half in halves)
        saved = hull.volume() - left
        sliver = min(half.volume() for half in halves) < _SLIVER * solid.volume()
        if sliver and saved < _FACE_PREFERENCE * excess:  # no progress
            continue
        cost = left + handicap * excess
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


def _within(hull: Manifold, solid: Manifold, inner: np.ndarray, tolerance: float) -> bool:
    """
    Tell whether a hull is within `tolerance` of its solid.

    At all of its surface, and at points `inner` (N, 3): cavities do not show at the surface.
    """
    corners, near = (v[f] for v, f in (mesh_of(hull), mesh_of(solid)))
    triangles = np.concatenate([np.repeat(inner[:, None], 3, axis=1), corners])
    return _all_near(triangles, near, near.min(axis=1), near.max(axis=1), tolerance)


def _gaps(solid: Manifold, hull: Manifold) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each face of a solid: free way to its hull along the normal (F,) [m]; normal, centre."""
    normal, centre = _planes(solid)
    outward, _ = _planes(hull)
    # Through the farthest vertex, not the face's own: of a face that is nearly a line the normal
    # is chance, and its plane would cut through the hull.
    offset = (outward @ vertices_of(hull).T).max(axis=1)
    return _exits(normal, centre, outward, offset), normal, centre


def _planes(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit normals and centres (F, 3) of a solid's faces, but for slivers."""
    vertices, faces = mesh_of(solid)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    twice_area = np.linalg.norm(normal, axis=1)
    sound = twice_area > _NO_AREA
    return normal[sound] / twice_area[sound, None], ((a + b + c) / 3.0)[sound]


@kernel
def _exits(normal, centre, outward, offset):
    """Distance (F,) from each centre along its normal to where it leaves the half-spaces."""
    exits = np.zeros(len(normal))
    for i in range(len(normal)):
        nearest = np.inf
        for j in range(len(outward)):
            ahead, left = 0.0, offset[j]
            for k in range(3):
                ahead += outward[j, k] * normal[i, k]
                left -= outward[j, k] * centre[i, k]
            if ahead > 1e-9:
                nearest = min(nearest, max(left, 0.0) / ahead)
        exits[i] = nearest if nearest < np.inf else 0.0
    return exits


@kernel
def _all_near(triangles, faces, low, high, tolerance):
    """
    Tell whether triangles (T, 3, 3) lie within `tolerance` of faces (F, 3, 3) in bounds low, high.

    The distance to one face is a convex function, greatest at a corner: a triangle whose corners
    are all near one and the same face is near it everywhere. One that is not is divided, down to
    where nothing between near corners can be far.
    """
    finest = (_FINEST * tolerance) ** 2
    stack = np.empty((128, 3, 3))
    for t in range(len(triangles)):
        beside = _beside(triangles[t], low, high, tolerance)
        stack[0] = triangles[t]
        height = 1
        while height:
            height -= 1
            verdict = _corners_near(stack[height], faces, beside, tolerance)
            if verdict < 0:
                return False
            if verdict == 0 and _halve(stack, height, finest):
                height += 2
    return True


@kernel
def _beside(triangle, low, high, tolerance):
    """Find the faces whose bounds are within `tolerance` of those of a triangle (3, 3)."""
    found = np.empty(len(low), np.int64)
    count = 0
    for f in range(len(low)):
        apart = False
        for k in range(3):
            least = min(triangle[0, k], triangle[1, k], triangle[2, k])
            most = max(triangle[0, k], triangle[1, k], triangle[2, k])
            apart |= least > high[f, k] + tolerance or most < low[f, k] - tolerance
        if not apart:
            found[count] = f
            count += 1
    return found[:count]


@kernel
def _halve(stack, height, finest):
    """Divide the triangle at `height` along its longest edge, unless that is finest already."""
    longest, edge = 0.0, 0
    for k in range(3):
        length = 0.0
        for i in range(3):
            length += (stack[height, (k + 1) % 3, i] - stack[height, k, i]) ** 2
        if length > longest:
            longest, edge = length, k
    if longest <= finest:
        return False
    other = (edge + 1) % 3
    for i in range(3):
        middle = (stack[height, edge, i] + stack[height, other, i]) / 2.0
        for k in range(3):
            stack[height + 1, k, i] = stack[height, k, i]
        stack[height, edge, i] = middle
        stack[height + 1, other, i] = middle
    return True


@kernel
def _corners_near(corners, faces, chosen, tolerance):
    """1 where all corners (3, 3) are near one chosen face, 0 where each is near some, else -1."""
    limit = tolerance * tolerance
    first = second = third = False
    for f in chosen:
        near_first = _to_triangle(corners[0], faces[f]) <= limit
        near_second = _to_triangle(corners[1], faces[f]) <= limit
        near_third = _to_triangle(corners[2], faces[f]) <= limit
        if near_first and near_second and near_third:
            return 1
        first, second, third = first or near_first, second or near_second, third or near_third
    return 0 if first and second and third else -1


@kernel
def _to_triangle(point, face):
    """Squared distance of a point (3,) from a triangle (3, 3)."""
    bb = bc = cc = pb = pc = pp = 0.0
    for k in range(3):
        b, c, p = face[1, k] - face[0, k], face[2, k] - face[0, k], point[k] - face[0, k]
        bb += b * b
        bc += b * c
        cc += c * c
        pb += p * b
        pc += p * c
        pp += p * p
    area = bb * cc - bc * bc
    if area > 1e-12 * bb * cc:
        v, w = (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area
        if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
            return max(pp - v * pb - w * pc, 0.0)
    # From the edges: each p - share * edge, with the share held to the edge.
    ab = pp - _saved(pb, bb)
    ac = pp - _saved(pc, cc)
    over = pp - 2.0 * pb + bb - _saved(pc - pb - bc + bb, cc - 2.0 * bc + bb)
    return max(min(ab, ac, over), 0.0)


@kernel
def _saved(along, length):
    """Give what a move along an edge takes from a squared distance; along: its dot product."""
    share = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
    return share * (2.0 * along - share * length)
