"""
Zones of ToF frames against the map: matched to the nearest plane that faces the beam, and weighed.

Point to plane (paper eqs. 1-4). All zones of one frame share (s, t), so that their residuals
gather in one 6x6 information of the body's pose. With b = R^T n the row of a zone is [b, q x b]
for a right perturbation. The noise acts along the beam: a hit at incidence n . d counts with
variance sigma_d^2 (n . d)^2 plus the floor.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from continuum_loc.compiling import kernel
from continuum_loc.mapping.lookup import nearest_facing_batch
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.voxel_index import VoxelIndex
import numpy as np

FIT_SIGMAS = 3.0  # a zone within so many sigmas of its surface counts as fitting


class Frame(NamedTuple):
    """
    A frame's zones, and what of the map they are matched to.

    q: (Z, 3) where they hit in the node's frame [m]; rays: (Z, 3) their beams; variance: (Z,) of
    their ranges [m^2], infinite where a zone is of no use; hits: (Z,) rows of the map, -1 where
    there is none; places: (Z, 4) where the zone was then [m], and the gate.
    """

    q: np.ndarray
    rays: np.ndarray
    variance: np.ndarray
    hits: np.ndarray
    places: np.ndarray


class Rules(NamedTuple):
    """How zones are matched, and how they count."""

    gate: float  # [m] farthest map point
    min_cosine: float  # of incidence
    reassociate: float  # [m] move beyond which a zone is matched anew
    floor2: float  # [m^2] noise across the surface
    footprint: float  # [rad] half width of a zone that counts as noise
    cauchy: float


class Planes(NamedTuple):
    """
    The surface at each point of a map.

    rows: (P, 7) point, unit normal, and weight of its information; variance: of the points across
    the surface [m^2].
    """

    rows: np.ndarray
    variance: float


class Surface(NamedTuple):
    """A map's planes, with the lookup of the nearest that faces a beam."""

    lookup: Any  # the `arrays` of a `VoxelIndex` of the same points
    planes: Planes


def surface_of(prior_map: PriorMap, planarity_power: float) -> Surface:
    """
    Weigh each point by its planarity, over the map's median and at most 1, to a power.

    A flat patch of scattered points has 0.8 to 0.9, which counts as whole: as a share of the
    information it would make the covariance too large.
    """
    flat = max(float(np.median(prior_map.planarity)), 1e-9)
    weight = np.minimum(prior_map.planarity / flat, 1.0) ** planarity_power
    rows = np.column_stack([prior_map.points, prior_map.normals, weight])
    return Surface(prior_map.index.arrays, Planes(rows, prior_map.sigma**2))


def thinned(surface: Surface, spacing: float) -> Surface:
    """
    Keep one point for each cell of `spacing` [m] and each octant of the normal.

    So both sides of a thin blade stay.
    """
    rows, variance = surface.planes
    points, normals = rows[:, :3], rows[:, 3:6]
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    octants = (normals > 0.0) @ np.array([1, 2, 4])
    keys = np.ravel_multi_index((*cells.T, octants), (*(cells.max(axis=0) + 1), 8))
    order = np.argsort(keys, kind='stable')
    kept = order[np.flatnonzero(np.diff(keys[order], prepend=-1))]
    index = VoxelIndex(points[kept], normals[kept])
    return Surface(index.arrays, Planes(rows[kept], variance))


def unmatched(zones: int) -> tuple[np.ndarray, np.ndarray]:
    """Make hits and places of zones that were never matched."""
    return np.full(zones, -1, np.int64), np.full((zones, 4), np.nan)


@kernel
def frame_of(frames, f):
    """Frame f of many."""
    return Frame(frames.q[f], frames.rays[f], frames.variance[f], frames.hits[f], frames.places[f])


@kernel
def match(T, frame, lookup, rules):
    """
    Match each zone to the nearest map point that faces its beam, at T_map_body.

    A zone that moved by no more than `reassociate` since it was matched with this gate keeps its
    hit.
    """
    q, rays, places, gate = frame.q, frame.rays, frame.places, rules.gate
    zones, asked = q.shape[0], 0
    points, directions = np.empty((zones, 3)), np.empty((zones, 3))
    rows, found, distance2 = np.empty(zones, np.int64), np.empty(zones, np.int64), np.empty(zones)
    for z in range(zones):
        if not np.isfinite(frame.variance[z]):
            continue
        moved2 = 0.0
        for i in range(3):
            points[asked, i] = T[i, 0] * q[z, 0] + T[i, 1] * q[z, 1] + T[i, 2] * q[z, 2] + T[i, 3]
            moved2 += (points[asked, i] - places[z, i]) ** 2
        if places[z, 3] == gate and moved2 <= rules.reassociate * rules.reassociate:
            continue
        for i in range(3):
            places[z, i] = points[asked, i]
            directions[asked, i] = (
                T[i, 0] * rays[z, 0] + T[i, 1] * rays[z, 1] + T[i, 2] * rays[z, 2]
            )
        places[z, 3] = gate
        rows[asked] = z
        asked += 1
    points, directions = points[:asked], directions[:asked]
    nearest_facing_batch(lookup, points, directions, gate, rules.min_cosine, found, distance2)
    for k in range(asked):
        frame.hits[rows[k]] = found[k]


@kernel
def weigh(T, frame, weight, planes, rules, local, tally):
    """
    Write one frame's normal equations at T_map_body; count its usable and fitting zones.

    Returns the robust cost, the sum of weighted squared residuals and the number of matched zones.
    An unmatched zone costs what a residual at the gate would, so that losing matches never pays.
    """
    H, g, row, variance = local.H, local.g, np.empty(6), frame.variance
    H[:, :] = 0.0
    g[:] = 0.0
    cost, squared, count = 0.0, 0.0, 0
    c2, gate2 = rules.cauchy * rules.cauchy, rules.gate * rules.gate
    for z in range(variance.shape[0]):
        if not np.isfinite(variance[z]):
            continue
        tally[0] += 1.0
        hit = frame.hits[z]
        if hit < 0:
            cost += 0.5 * weight * c2 * np.log1p(gate2 / (c2 * (variance[z] + rules.floor2)))
            continue
        r = _residual(T, frame.q, z, planes.rows, hit, row)
        total = _spread(frame, z, row, rules) + planes.variance
        u2 = r * r / total
        robust = 1.0 / (1.0 + u2 / c2)
        alpha = weight * planes.rows[hit, 6]
        information = alpha * robust / total
        for i in range(6):
            scaled = information * row[i]
            g[i] += scaled * r
            for j in range(i + 1):
                H[i, j] += scaled * row[j]
        cost += 0.5 * alpha * c2 * np.log1p(u2 / c2)
        squared += u2 * robust
        count += 1
        if u2 < FIT_SIGMAS * FIT_SIGMAS:
            tally[1] += 1.0
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return cost, squared, count


@kernel
def weigh_ranges(T, frame, weight, planes, rules, unit, local):
    """
    Write one frame's equations by the body's pose, and by offset and scale of its ranges.

    unit: where the sensor is in the node's frame (3,), and 1 over the share of each zone's range
    that it measures (Z,). What the map does not match is left out.
    """
    H, g, row, variance = local.H, local.g, np.empty(8), frame.variance
    H[:, :] = 0.0
    g[:] = 0.0
    c2 = rules.cauchy * rules.cauchy
    for z in range(variance.shape[0]):
        hit = frame.hits[z]
        if hit < 0 or not np.isfinite(variance[z]):
            continue
        r = _residual(T, frame.q, z, planes.rows, hit, row)
        total = _spread(frame, z, row, rules) + planes.variance
        cosine, distance = 0.0, 0.0
        for i in range(3):
            cosine += row[i] * frame.rays[z, i]
            distance += (frame.q[z, i] - unit.origin[i]) * frame.rays[z, i]
        row[6], row[7] = -cosine * unit.along[z], -cosine * distance
        information = weight * planes.rows[hit, 6] / (1.0 + r * r / (total * c2)) / total
        for i in range(8):
            scaled = information * row[i]
            g[i] += scaled * r
            for j in range(8):
                H[i, j] += scaled * row[j]


@kernel(inline='always')
def _residual(T, q, z, planes, hit, row):
    """Distance of zone z from the plane that it hit, and its derivative by the pose, row (6,)."""
    a, b, c = q[z, 0], q[z, 1], q[z, 2]
    x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
    y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
    w = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
    nx, ny, nz = planes[hit, 3], planes[hit, 4], planes[hit, 5]
    row[0] = T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz
    row[1] = T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz
    row[2] = T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz
    row[3] = b * row[2] - c * row[1]
    row[4] = c * row[0] - a * row[2]
    row[5] = a * row[1] - b * row[0]
    return nx * (x - planes[hit, 0]) + ny * (y - planes[hit, 1]) + nz * (w - planes[hit, 2])


@kernel(inline='always')
def _spread(frame, z, row, rules):
    """Variance of zone z across a surface whose normal in the node's frame is row[:3]."""
    rays, q = frame.rays, frame.q
    cosine = row[0] * rays[z, 0] + row[1] * rays[z, 1] + row[2] * rays[z, 2]
    cosine2 = cosine * cosine
    width = rules.footprint * np.sqrt(q[z, 0] * q[z, 0] + q[z, 1] * q[z, 1] + q[z, 2] * q[z, 2])
    return frame.variance[z] * cosine2 + width * width * (1.0 - cosine2) + rules.floor2
