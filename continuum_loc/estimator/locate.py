"""
A start from nothing: where in the map a base may be of which only a region is known.

The shape is what the first samples tell (strain, else straight), and gravity tells the tilt. So
the newest ToF frames are one rigid cloud with four unknowns, place and heading, and a grid of
these is scored by the distances of its points to the map's surface. The best, mutually different
ones are improved step by step; which is right, the filter itself decides (`Recovery.locate`).
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.compiling import kernel
from continuum_loc.estimator.search import Snapshot
from continuum_loc.estimator.state import Grid, shape_from_strain
from continuum_loc.mapping.distances import DistanceField, FAR
import numpy as np
from scipy.spatial.transform import Rotation

STEP, TURN = 0.08, np.radians(6.0)  # of the grid
LEVELS = 4  # of halving both
IMPROVED, KEPT = 400, 6  # candidates that are improved, and given to the filter
DISTINCT = (0.06, np.radians(4.0))  # [m, rad] nearer ones are the same
MOST_POINTS, MOST_GRID = 150, 1_500_000


class Region(NamedTuple):
    """Where a base may be: T_map_base (4, 4), and how far from it [m, rad]."""

    T_map_base: np.ndarray
    reach: float
    turn: float


class Candidate(NamedTuple):
    """A place of the base (4, 4), and the mean squared distance of what is seen from there."""

    T_map_base: np.ndarray
    score: float


class BaseSearch:
    """Finds places of a base that fit a snapshot of the ToF frames."""

    def __init__(self, grid: Grid, field: DistanceField, up: np.ndarray):
        self.grid, self.field, self._up = grid, field, up

    def find(
        self, snapshot: Snapshot, strain: np.ndarray, up_base: np.ndarray | None, region: Region
    ) -> list[Candidate]:
        """
        Best places, best first; strain (N, 6) of the nodes.

        up_base: (3,) the direction against gravity in the base's frame; None where nobody tells,
        and the region's tilt has to do.
        """
        points = self._points(snapshot, strain)
        T = self._levelled(region.T_map_base, up_base)
        places, headings = self._grid_of(region)
        turns = Rotation.from_rotvec(headings[:, None] * self._up).as_matrix() @ T[:3, :3]
        clouds = np.ascontiguousarray(np.einsum('hij,pj->hpi', turns, points))
        scores = np.empty((len(places), len(headings)))
        _score_all(self.field, places, clouds, scores)
        order = np.argsort(scores, axis=None)[:IMPROVED]
        found = [self._improved(*self._at(i, places, headings), T, points) for i in order]
        return _different(sorted(found, key=_score_of))

    def _points(self, snapshot: Snapshot, strain: np.ndarray) -> np.ndarray:
        """(P, 3) what the frames see, in the base's frame, thinned."""
        T = shape_from_strain(np.eye(4), self.grid.s, strain)[snapshot.nodes]
        q = np.einsum('fij,fzj->fzi', T[:, :3, :3], snapshot.q) + T[:, None, :3, 3]
        q = q.reshape(-1, 3)
        q = q[np.isfinite(q).all(axis=1)]
        return np.ascontiguousarray(q[:: max(len(q) // MOST_POINTS, 1)])

    def _levelled(self, T_map_base: np.ndarray, up_base: np.ndarray | None) -> np.ndarray:
        """Turn a base by the least angle that puts its `up` upright."""
        T = T_map_base.copy()
        if up_base is not None:
            seen = T[:3, :3] @ up_base
            axis = np.cross(seen, self._up)
            sine = np.linalg.norm(axis)
            if sine > 1e-9:
                angle = np.arctan2(sine, seen @ self._up)
                T[:3, :3] = lie.so3_exp(angle / sine * axis) @ T[:3, :3]
        return T

    def _grid_of(self, region: Region) -> tuple[np.ndarray, np.ndarray]:
        """Places (H, 3) in the region and in the map's box, and headings (K,)."""
        field = self.field
        low, high = field.origin, field.origin + field.voxel * np.array(field.distance.shape)
        centre = region.T_map_base[:3, 3]
        low, high = (
            np.maximum(low - STEP, centre - region.reach),
            np.minimum(high + STEP, centre + region.reach),
        )
        turn = min(region.turn, np.pi)
        headings = np.linspace(-turn, turn, max(int(np.ceil(2.0 * turn / TURN)), 1) + 1)
        most = MOST_GRID / len(headings)
        step = max(STEP, float(np.cbrt(np.prod(np.maximum(high - low, STEP)) / most)))
        axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        places = np.stack(np.meshgrid(*axes, indexing='ij'), -1).reshape(-1, 3)
        near = np.linalg.norm(places - centre, axis=1) <= region.reach + step
        return places[near], headings

    @staticmethod
    def _at(index: int, places: np.ndarray, headings: np.ndarray) -> tuple[np.ndarray, float]:
        return places[index // len(headings)], float(headings[index % len(headings)])

    def _improved(
        self, place: np.ndarray, heading: float, T: np.ndarray, points: np.ndarray
    ) -> Candidate:
        """Go downhill in place and heading, by steps that are halved."""
        at = np.append(place, heading)
        rotated = points @ T[:3, :3].T
        score = _downhill(self.field, rotated, self._up, at)
        found = np.eye(4)
        found[:3, :3] = lie.so3_exp(at[3] * self._up) @ T[:3, :3]
        found[:3, 3] = at[:3]
        return Candidate(found, score)


def _score_of(candidate: Candidate) -> float:
    return candidate.score


def _different(ordered: list[Candidate]) -> list[Candidate]:
    """Keep the best, no two of which are the same."""
    kept: list[Candidate] = []
    for one in ordered:
        gaps = [lie.log(lie.inverse(other.T_map_base) @ one.T_map_base) for other in kept]
        apart = (
            np.linalg.norm(gap[:3]) > DISTINCT[0] or np.linalg.norm(gap[3:]) > DISTINCT[1]
            for gap in gaps
        )
        if all(apart):
            kept.append(one)
        if len(kept) == KEPT:
            break
    return kept


@kernel
def _distance(field, x, y, z):
    """Distance [m] of a point; FAR outside."""
    i = int((x - field.origin[0]) / field.voxel)
    j = int((y - field.origin[1]) / field.voxel)
    k = int((z - field.origin[2]) / field.voxel)
    shape = field.distance.shape
    if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return FAR
    return field.distance[i, j, k]


@kernel
def _score_all(field, places, clouds, scores):
    """Write the mean squared distance (H, K) of the clouds (K, P, 3) at places (H, 3)."""
    count = clouds.shape[1]
    for h in range(places.shape[0]):
        x, y, z = places[h]
        for k in range(clouds.shape[0]):
            total = 0.0
            for p in range(count):
                cloud = clouds[k, p]
                d = _distance(field, x + cloud[0], y + cloud[1], z + cloud[2])
                total += d * d
            scores[h, k] = total / count


@kernel
def _score_at(field, points, up, at):
    """Mean squared distance of points (P, 3), turned about `up` by at[3] and put at at[:3]."""
    cos, sin = np.cos(at[3]), np.sin(at[3])
    total = 0.0
    for p in range(points.shape[0]):
        a, b, c = points[p]
        along = (1.0 - cos) * (up[0] * a + up[1] * b + up[2] * c)
        x = cos * a + sin * (up[1] * c - up[2] * b) + along * up[0]
        y = cos * b + sin * (up[2] * a - up[0] * c) + along * up[1]
        z = cos * c + sin * (up[0] * b - up[1] * a) + along * up[2]
        d = _distance(field, x + at[0], y + at[1], z + at[2])
        total += d * d
    return total / points.shape[0]


@kernel
def _downhill(field, points, up, at):
    """Improve `at` (4,) in place; its score."""
    best = _score_at(field, points, up, at)
    for level in range(LEVELS):
        share = 0.5 ** (level + 1)
        for _ in range(6):
            before = best
            for axis in range(4):
                step = share * (TURN if axis == 3 else STEP)
                for sign in (1.0, -1.0):
                    at[axis] += sign * step
                    score = _score_at(field, points, up, at)
                    if score < best:
                        best = score
                        break
                    at[axis] -= sign * step
            if best >= before:
                break
    return best
