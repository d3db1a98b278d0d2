"""The index is exact against brute force and SciPy, for any cloud, query and cache."""

from continuum_loc.errors import MapError
from continuum_loc.mapping.facing import PATIENCE
from continuum_loc.mapping.voxel_index import VoxelIndex
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial import cKDTree


def wavy_cylinder(count, seed):
    """Points and outward normals of a surface with concave and convex parts."""
    rng = np.random.default_rng(seed)
    angle, x = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 0.5, count)
    radius = 0.4 + 0.03 * np.sin(7 * angle)
    points = np.column_stack([x, radius * np.cos(angle), radius * np.sin(angle)])
    normals = np.column_stack([np.zeros(count), -np.cos(angle), -np.sin(angle)])
    return points, normals


def brute_force(points, queries, max_distance, allowed=None):
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    if allowed is not None:
        distance[~allowed] = np.inf
    distance[distance >= max_distance] = np.inf
    return distance.min(axis=1)


def clouds():
    """
    Clouds that break indices.

    Few points, coincident ones, lines, lattices with ties, far outliers.
    """
    coordinate = st.one_of(
        st.integers(-3, 3).map(float), st.floats(-1.0, 1.0), st.sampled_from([0.0, 1e-9, 50.0])
    )
    return st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=60).map(
        np.array
    )


@settings(max_examples=150, deadline=None)
@given(
    clouds(),
    clouds(),
    st.sampled_from([1e-3, 0.05, 0.3, 2.0, np.inf]),
    st.sampled_from([None, 0.02, 0.5, 7.0]),
)
def test_nearest_is_the_nearest_of_any_cloud(points, queries, max_distance, cell):
    index = VoxelIndex(points, cell=cell, reach=0.2)
    row, distance = index.nearest(queries, max_distance)
    expected = brute_force(points, queries, max_distance)
    np.testing.assert_allclose(distance, expected, rtol=1e-12, atol=1e-15)
    hit = row >= 0
    np.testing.assert_array_equal(hit, np.isfinite(expected))
    np.testing.assert_allclose(
        np.linalg.norm(points[row[hit]] - queries[hit], axis=1), distance[hit]
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(-1.0, 1.0), st.sampled_from([0.01, 0.1, 0.5]))
def test_nearest_facing_is_the_nearest_that_faces(seed, min_cos, max_distance):
    rng = np.random.default_rng(seed)
    points, normals = wavy_cylinder(500, seed)
    normals *= rng.choice([-1.0, 1.0], (500, 1))  # two-sided, like thin blades
    queries = points[rng.integers(0, 500, 40)] + rng.normal(0, 0.03, (40, 3))
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    index = VoxelIndex(points, normals)
    cosine = -np.einsum('qi,pi->qp', directions, normals)
    # Rounding may decide either way on the limit itself.
    clear = np.abs(cosine - min_cos).min(axis=1) > 1e-12
    expected = brute_force(points, queries, max_distance, cosine >= min_cos)
    for _ in range(PATIENCE + 1):  # first by search, then from the lists
        _, distance = index.nearest_facing(queries, directions, max_distance, min_cos)
        np.testing.assert_allclose(distance[clear], expected[clear], rtol=1e-12)


def test_agrees_with_a_kd_tree_on_a_large_map_near_and_far():
    points, _ = wavy_cylinder(100_000, 1)
    rng = np.random.default_rng(2)
    queries = np.concatenate(
        [points[:3000] + rng.normal(0, 0.02, (3000, 3)), rng.uniform(-1, 1, (500, 3))]
    )
    index = VoxelIndex(points)
    _, distance = index.nearest(queries)
    np.testing.assert_allclose(distance, cKDTree(points).query(queries)[0], rtol=1e-12)


def test_the_centre_of_a_sphere_where_every_point_is_a_candidate():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(20_000, 3))
    points *= 0.08 / np.linalg.norm(points, axis=1, keepdims=True)
    queries = rng.normal(0, 1e-3, (50, 3))
    index = VoxelIndex(points)
    _, distance = index.nearest(queries)
    np.testing.assert_allclose(distance, cKDTree(points).query(queries)[0], rtol=1e-12)


def test_of_equally_near_points_the_first_is_taken_whatever_the_cache_holds():
    axis = np.arange(-2.0, 3.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    points = np.random.default_rng(7).permutation(np.concatenate([lattice, lattice]))
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    queries = lattice[:40] + 0.5  # eight places are equally near, and two points are at each
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    expected = np.argmax(distance == distance.min(axis=1, keepdims=True), axis=1)
    index = VoxelIndex(points, normals, reach=2.0)
    for _ in range(PATIENCE + 2):
        np.testing.assert_array_equal(index.nearest(queries)[0], expected)
        np.testing.assert_array_equal(index.nearest_facing(queries, [0, 0, -1.0])[0], expected)
    assert index.cache_use['made'] > 0


def test_lists_made_for_one_angle_of_incidence_do_not_serve_another():
    points, normals = wavy_cylinder(2000, 8)
    rng = np.random.default_rng(9)
    queries = points[:50] + rng.normal(0, 0.02, (50, 3))
    directions = -normals[:50]
    cosine = -np.einsum('qi,pi->qp', directions, normals)
    index = VoxelIndex(points, normals)
    for min_cos in (0.9999, 0.1, -0.5, 0.9999):
        expected = brute_force(points, queries, 0.1, cosine >= min_cos)
        for _ in range(PATIENCE + 1):
            _, distance = index.nearest_facing(queries, directions, 0.1, min_cos)
            np.testing.assert_allclose(distance, expected, rtol=1e-12)


def test_single_precision_never_decides():
    """
    Points a nanometre apart, far from the map's corner, and faces on the very limit of a beam.

    The corner is so far away that single precision cannot tell any of these points from another.
    """
    rng = np.random.default_rng(12)
    cluster = np.array([900.0, -400.0, 300.0]) + 1e-9 * rng.integers(-500, 500, (200, 3))
    points = np.concatenate([cluster, [[0.0, 0.0, 0.0], [-900.0, 400.0, -300.0]]])
    tilt = rng.choice([-1e-9, 0.0, 1e-9], len(points))
    normals = np.column_stack([np.cos(tilt), np.sin(tilt), 0.0 * tilt])
    queries = cluster[:50] + 1e-7 * rng.normal(size=(50, 3))
    beams = np.tile([0.0, -1.0, 0.0], (50, 1))
    index = VoxelIndex(points, normals, cell=0.05)
    faces = -np.einsum('qi,pi->qp', beams, normals) >= 0.0
    for allowed, ask in (
        (None, lambda: index.nearest(queries)),
        (faces, lambda: index.nearest_facing(queries, beams, 0.05, 0.0)),
    ):
        expected = brute_force(points, queries, 0.05, allowed)
        for _ in range(PATIENCE + 1):
            np.testing.assert_allclose(ask()[1], expected, rtol=1e-12)
    assert index.cache_use['groups'] > 0


def test_where_the_map_lies_changes_nothing():
    points, normals = wavy_cylinder(5000, 13)
    points = np.round(points * 2.0**20) / 2.0**20  # so that moving it does not round it
    rng = np.random.default_rng(14)
    queries = np.round((points[:500] + rng.normal(0, 0.02, (500, 3))) * 2.0**20) / 2.0**20
    away = np.array([2.0**21, -(2.0**20), 2.0**10])  # metres, as in a national grid
    here, there = VoxelIndex(points, normals), VoxelIndex(points + away, normals)
    for one, other in zip(here.nearest(queries), there.nearest(queries + away), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_cache_that_overflows_changes_nothing():
    """It may be emptied in the middle of a batch, as a batch that alone overflows it shows."""
    points, normals = wavy_cylinder(20_000, 4)
    rows = np.arange(4000)
    queries = points[rows] + np.random.default_rng(5).normal(0, 0.01, (4000, 3))
    small, large = VoxelIndex(points, normals, cache_cells=64), VoxelIndex(points, normals)
    # Neighbours in a row, so that the small cache makes lists before it is full.
    queries, beams = (
        np.repeat(part, 30, axis=0) for part in (queries[:400], -normals[rows[:400]])
    )
    for _ in range(3):
        np.testing.assert_array_equal(
            small.nearest_facing(queries, beams, 0.1, 0.2)[0],
            large.nearest_facing(queries, beams, 0.1, 0.2)[0],
        )
    assert small.cache_use['emptied'] > 1 and large.cache_use['emptied'] == 1
    assert small.cache_use['made'] > 64 and small.cache_use['cells'] <= 65


def test_a_reserved_index_has_all_its_memory_and_takes_no_more_wherever_it_is_asked():
    """
    Memory is taken when it is written first: `reserve` writes all that lookups ever write.

    That stays as large as it is, while lists come and go.
    """
    points, normals = wavy_cylinder(20_000, 10)
    index = VoxelIndex(points, normals, cache_cells=1 << 12)
    cache = [array for array in index.arrays if isinstance(array, np.ndarray)][-8:]
    before = [array.copy() for array in cache]
    slots, *untouched, _ = cache
    for array in untouched:
        array.fill(7)
    index.reserve()
    assert not any((array == 7).any() for array in untouched)
    np.testing.assert_array_equal(slots, before[0])  # a table of -1, written when it was made
    rng = np.random.default_rng(11)
    for _ in range(4):
        rows = rng.integers(0, len(points), 1500)
        queries = points[rows] + 0.02 * rng.normal(size=(len(rows), 3))
        for _ in range(PATIENCE + 1):
            index.nearest_facing(queries, -normals[rows], 0.1, 0.3)
    assert index.cache_use['emptied'] > 0 and index.cache_use['groups'] > 1000
    after = [array for array in index.arrays if isinstance(array, np.ndarray)][-8:]
    assert all(one is other for one, other in zip(after, cache, strict=True))


def test_copies_share_the_cloud_and_not_the_cache():
    points, normals = wavy_cylinder(1000, 6)
    index = VoxelIndex(points, normals).prepare()
    twin = index.copy()
    place = np.tile(points[0], (PATIENCE + 1, 1))
    twin.nearest_facing(place, -normals[0], 0.1, 0.3)
    assert twin.cache_use['made'] == 1 and index.cache_use['made'] == 0
    assert twin.arrays.points is index.arrays.points and twin.near is index.near


@pytest.mark.parametrize('query', [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 1e300]])
def test_a_query_that_is_no_place_has_no_neighbour(query):
    row, distance = VoxelIndex(np.zeros((1, 3)), cell=0.1).nearest(np.array([query]))
    assert row[0] == -1 and distance[0] == np.inf


def test_max_distance_is_a_strict_limit():
    index = VoxelIndex(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert index.nearest(np.array([[0.25, 0.0, 0.0]]), 0.25)[0][0] == -1
    assert index.nearest(np.array([[0.25, 0.0, 0.0]]), 0.2500001)[0][0] == 0


@pytest.mark.parametrize(
    ('points', 'said'),
    [
        (np.empty((0, 3)), r'\(P, 3\)'),
        (np.zeros((4, 2)), r'\(4, 2\)'),
        (np.array([[0, 0, 0], [0, np.nan, 0.0]]), 'first is row 1'),
    ],
)
def test_unusable_points_are_refused_by_name(points, said):
    with pytest.raises(MapError, match=said):
        VoxelIndex(points)


def test_a_cell_too_small_for_the_cloud_is_refused():
    with pytest.raises(MapError, match='too small'):
        VoxelIndex(np.array([[0.0, 0, 0], [1e4, 0, 0]]), cell=1e-4)


@pytest.mark.parametrize(
    ('points', 'options', 'said'),
    [
        ([[0.0, 0, 0], [2e9, 0, 0]], {}, 'at most 1e'),
        ([[0.0, 0, 0]], {'reach': np.inf}, 'finite'),
        ([[0.0, 0, 0]], {'cell': 0.0}, 'cell must be > 0'),
    ],
)
def test_unusable_sizes_are_refused(points, options, said):
    with pytest.raises(MapError, match=said):
        VoxelIndex(np.array(points), **options)


@pytest.mark.parametrize('shape', [(3,), (4, 2)])
def test_queries_of_another_shape_are_refused(shape):
    index = VoxelIndex(np.zeros((1, 3)), np.ones((1, 3)))
    for ask in (index.nearest, lambda q: index.nearest_facing(q, [0.0, 0.0, 1.0])):
        with pytest.raises(MapError, match='queries must be'):
            ask(np.zeros(shape))


def test_facing_needs_normals():
    with pytest.raises(MapError, match='normals'):
        VoxelIndex(np.zeros((1, 3))).nearest_facing(np.zeros((1, 3)), np.ones((1, 3)))
