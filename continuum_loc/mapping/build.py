"""Prior maps from meshes and from bare clouds: blue-noise sampling, normals, planarity."""

from __future__ import annotations

from continuum_loc.compiling import kernel
from continuum_loc.errors import MapError
from continuum_loc.formats.shapes import finite_rows
from continuum_loc.mapping.grid import spatial_order
from continuum_loc.mapping.prior_map import PriorMap
import numpy as np

NEIGHBOURS = 20  # of a PCA neighbourhood
# Neighbours whose normals differ by more than 120 deg are the other side of a thin part.
SAME_SIDE = -0.5
# Random darts per (area / spacing^2): more fill the last gaps, at a price in time.
CANDIDATES = 4.0
DENSITY = 0.537  # points per (area / spacing^2) that so many darts leave on a plane


def sample_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    spacing: float | None = None,
    count: int | None = None,
    seed: int = 0,
    sigma: float = 1e-4,
    source: str = 'mesh',
    notes: tuple[str, ...] = (),
) -> PriorMap:
    """
    Blue-noise points on a triangle mesh with the triangles' normals.

    Normals point outward by the right-hand rule. Raises MapError for a mesh without area.

    vertices: (V, 3) [m]; faces: (F, 3). No two points on the same side of the surface are closer
    than `spacing` [m]; or give `count`, about as many points as wanted. The two sides of a thin
    part are sampled independently, and normals are the triangles' own: PCA mixes the sides of a
    thin blade up.
    source, notes: of the map.
    """
    vertices, faces = _checked_mesh(vertices, faces, source)
    areas, normals = _triangle_areas_and_normals(vertices, faces)
    proper = areas > 0.0
    if not proper.any():
        raise MapError(f'{source}: no triangle with an area')
    faces, areas, normals = faces[proper], areas[proper], normals[proper]
    spacing = _spacing_for(areas.sum(), spacing, count, source)
    generator = np.random.default_rng(seed)
    wanted = int(np.ceil(CANDIDATES * areas.sum() / spacing**2)) + 16
    points, triangle = _uniform_on_triangles(vertices[faces], areas, wanted, generator)
    kept = _poisson_subset(points, normals[triangle], spacing)
    points, triangle = points[kept], triangle[kept]
    order = spatial_order(points, 4.0 * spacing)
    points, normals = points[order], normals[triangle[order]]
    planarity, _ = local_shape(points, normals)
    return PriorMap(
        points,
        normals,
        planarity,
        sigma=sigma,
        spacing=spacing,
        source=source,
        seed=seed,
        notes=notes,
    )


def map_from_cloud(
    points: np.ndarray,
    normals: np.ndarray | None = None,
    planarity: np.ndarray | None = None,
    *,
    viewpoint: np.ndarray | None = None,
    sigma: float = 1e-4,
    source: str = 'cloud',
    notes: tuple[str, ...] = (),
) -> PriorMap:
    """
    Make a map from a measured cloud (P, 3) [m].

    What is missing of normals (P, 3) and planarity (P,) comes from PCA. PCA normals are turned
    toward `viewpoint` (3,) [m]; without one their sign means nothing and the map says so. source,
    notes: of the map.
    """
    points = finite_rows(points, 'points', source)
    oriented = normals is not None or viewpoint is not None
    if normals is not None:
        normals = _unit(finite_rows(normals, 'normals', source), source)
    if normals is None or planarity is None:
        alpha, directions = local_shape(points, normals)
        planarity = alpha if planarity is None else planarity
        normals = _turned(directions, points, viewpoint) if normals is None else normals
    return PriorMap(
        points,
        normals,
        planarity,
        sigma=sigma,
        spacing=_typical_spacing(points),
        oriented=oriented,
        source=source,
        notes=notes,
    )


def _turned(normals, points, viewpoint):
    """Turn normals toward a viewpoint, where there is one."""
    if viewpoint is None:
        return normals
    toward = np.einsum('ij,ij->i', normals, np.asarray(viewpoint, dtype=np.float64) - points)
    return np.where(toward < 0.0, -1.0, 1.0)[:, None] * normals


def _typical_spacing(points, sample=20_000):
    """Median distance [m] to the nearest neighbour of an even sample of the points."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.0
    distance, _ = cKDTree(points, balanced_tree=False).query(
        points[:: max(len(points) // sample, 1)], k=2
    )
    return float(np.median(distance[:, 1]))


def local_shape(
    points: np.ndarray,
    normals: np.ndarray | None,
    neighbours: int = NEIGHBOURS,
    chunk: int = 50_000,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Planarity (P,) and PCA normals (P, 3) of arbitrary sign.

    PCA of each point's nearest neighbours; where `normals` are given, of those on its own side of
    the surface only. A neighbourhood of fewer than three points has planarity 0.
    """
    from scipy.spatial import cKDTree

    count = min(neighbours, len(points))
    planarity, directions = np.zeros(len(points)), np.tile([0.0, 0.0, 1.0], (len(points), 1))
    if count < 3:
        return planarity, directions
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    for start in range(0, len(points), chunk):
        part = slice(start, start + chunk)
        near = tree.query(points[part], k=count)[1]
        planarity[part], directions[part] = _principal_shape(points, near, normals, part)
    return planarity, directions


def _principal_shape(points, near, normals, part):
    """Planarity and least principal direction of neighbourhoods given as rows `near` (C, k)."""
    weight = np.ones(near.shape)
    if normals is not None:
        weight = (np.einsum('ij,ikj->ik', normals[part], normals[near]) > SAME_SIDE).astype(
            np.float64
        )
    offsets = points[near] - points[part][:, None]
    total = weight.sum(axis=1)
    offsets -= (np.einsum('ik,ikj->ij', weight, offsets) / total[:, None])[:, None]
    covariance = np.einsum('ik,ika,ikb->iab', weight, offsets, offsets) / total[:, None, None]
    values, vectors = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(values, 0.0))
    with np.errstate(invalid='ignore'):
        planarity = np.where(
            (sigma[:, 2] > 0.0) & (total >= 3), (sigma[:, 1] - sigma[:, 0]) / sigma[:, 2], 0.0
        )
    return np.clip(planarity, 0.0, 1.0), vectors[:, :, 0]


def _checked_mesh(vertices, faces, source):
    vertices = finite_rows(vertices, 'vertices', source)
    faces = np.asarray(faces, dtype=np.int64)
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise MapError(f'{source}: faces must be (F, 3) with F >= 1, got {faces.shape}')
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MapError(
            f'{source}: faces name vertices {faces.min()} to {faces.max()}, '
            f'there are {len(vertices)}'
        )
    return vertices, faces


def _unit(normals, source):
    length = np.linalg.norm(normals, axis=1)
    bad = np.flatnonzero(length < 1e-9)
    if len(bad):
        raise MapError(
            f'{source}: {len(bad)} of {len(normals)} normals have length 0, '
            f'the first is number {bad[0]}'
        )
    return normals / length[:, None]


def _spacing_for(area, spacing, count, source):
    if (spacing is None) == (count is None):
        raise MapError(f'{source}: give either spacing or count')
    if spacing is None:
        spacing = np.sqrt(DENSITY * area / count) if count > 0 else 0.0
    if not spacing > 0.0 or not np.isfinite(spacing):
        raise MapError(f'{source}: spacing and count must be > 0')
    return float(spacing)


def _triangle_areas_and_normals(vertices, faces):
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    doubled = np.cross(b - a, c - a)
    length = np.linalg.norm(doubled, axis=1)
    return 0.5 * length, doubled / np.where(length > 0.0, length, 1.0)[:, None]


def _uniform_on_triangles(corners, areas, count, generator):
    """`count` points (count, 3) uniform by area, in random order, and the triangle of each."""
    cumulative = np.cumsum(areas)
    triangle = np.searchsorted(cumulative, generator.random(count) * cumulative[-1], side='right')
    triangle = np.minimum(triangle, len(areas) - 1)
    u, v = generator.random(count), generator.random(count)
    folded = u + v > 1.0
    u[folded], v[folded] = 1.0 - u[folded], 1.0 - v[folded]
    a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), triangle


def _poisson_subset(points, normals, spacing):
    """
    Rows of a subset in which no two points of the same side are closer than `spacing`.

    Earlier rows go first.
    """
    cells = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64) + 1
    if cells.max() >= 1 << 20:
        raise MapError(
            f'spacing {spacing} m is too small for a mesh '
            f'{np.ptp(points, axis=0).max():.6g} m across'
        )
    slots = np.full(1 << int(np.ceil(np.log2(2 * len(points)))), -1, np.int32)
    following = np.full(len(points), -1, np.int32)
    return np.flatnonzero(_throw_darts(points, normals, cells, spacing, slots, following))


@kernel
def _throw_darts(points, normals, cells, spacing, slots, following):
    """
    Accept each point unless an accepted one of its side lies within `spacing`.

    Accepted points are chained by hash of their cell (edge `spacing`); a chain may hold other
    cells' points, which the distance test passes over.
    """
    accepted = np.zeros(points.shape[0], np.bool_)
    mask = slots.shape[0] - 1
    for p in range(points.shape[0]):
        free = True
        for neighbour in range(27):
            row = _cell_row(
                cells[p, 0] + neighbour // 9 - 1,
                cells[p, 1] + neighbour // 3 % 3 - 1,
                cells[p, 2] + neighbour % 3 - 1,
                mask,
            )
            other = slots[row]
            while other >= 0 and free:
                free = not _crowds(points, normals, p, other, spacing)
                other = following[other]
            if not free:
                break
        if free:
            accepted[p] = True
            row = _cell_row(cells[p, 0], cells[p, 1], cells[p, 2], mask)
            following[p], slots[row] = slots[row], p
    return accepted


@kernel(inline='always')
def _cell_row(i, j, k, mask):
    mixed = (
        (np.uint64(i) * np.uint64(73856093))
        ^ (np.uint64(j) * np.uint64(19349663))
        ^ (np.uint64(k) * np.uint64(83492791))
    )
    return np.int64(((mixed * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(24)) & np.uint64(mask))


@kernel(inline='always')
def _crowds(points, normals, p, other, spacing):
    dx = points[p, 0] - points[other, 0]
    dy = points[p, 1] - points[other, 1]
    dz = points[p, 2] - points[other, 2]
    if dx * dx + dy * dy + dz * dz >= spacing * spacing:
        return False
    return (
        normals[p, 0] * normals[other, 0]
        + normals[p, 1] * normals[other, 1]
        + normals[p, 2] * normals[other, 2]
    ) > SAME_SIDE
