"""The index is exact against brute force and SciPy, for any cloud and query."""

from continuum_loc.errors import MapError
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.mapping.voxel_index import VoxelIndex
from continuum_loc.nodes.support.memory import SeenScene
from continuum_loc.nodes.support.warm_up import warm_up
from continuum_loc.settings import parse_settings
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial import cKDTree
from worlds import rod, room_map


def wavy_cylinder(count, seed):
    """Points and outward normals of a surface with concave and convex parts."""
    rng = np.random.default_rng(seed)
    angle, x = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 0.5, count)
    radius = 0.4 + 0.03 * np.sin(7 * angle)
    points = np.column_stack([x, radius * np.cos(angle), radius * np.sin(angle)])
    normals = np.column_stack([np.zeros(count), -np.cos(angle), -np.sin(angle)])
    return points, normals


def any_way(points, edge=None):
    """Index a cloud whose normals do not matter."""
    return VoxelIndex(points, np.ones(np.shape(points)), edge)


def brute_force(points, queries, max_distance, allowed=None):
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    if allowed is not None:
        distance[~allowed] = np.inf
    distance[distance >= max_distance] = np.inf
    return distance.min(axis=1)


def unit(rng, count):
    """Random directions."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


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
def test_nearest_is_the_nearest_of_any_cloud(points, queries, max_distance, edge):
    index = any_way(points, edge)
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
    directions = unit(rng, 40)
    index = VoxelIndex(points, normals)
    cosine = -np.einsum('qi,pi->qp', directions, normals)
    # Rounding may decide either way on the limit itself.
    clear = np.abs(cosine - min_cos).min(axis=1) > 1e-12
    expected = brute_force(points, queries, max_distance, cosine >= min_cos)
    _, distance = index.nearest_facing(queries, directions, max_distance, min_cos)
    np.testing.assert_allclose(distance[clear], expected[clear], rtol=1e-12)


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 10**6), st.integers(-6, 6), st.integers(0, 5), st.sampled_from([None, 0.3, 3.0])
)
def test_rows_and_distances_are_those_of_a_loop_over_all_points_to_the_bit(
    seed, decades, away, edge
):
    """On lattices with many ties, of any size [m] and far from the origin."""
    rng, scale = np.random.default_rng(seed), 10.0**decades
    points = scale * (rng.integers(-4, 5, (50, 3)) + 10.0**away * rng.normal(size=3))
    queries = points[rng.integers(0, 50, 30)] + scale * rng.integers(-2, 3, (30, 3)) / 2.0
    normals, beams = unit(rng, 50), unit(rng, 30)
    min_cosine, max_distance = rng.uniform(-1.0, 1.0), scale * rng.choice([0.9, 3.0, np.inf])
    e, cosine = points - queries[:, None], normals * beams[:, None]
    distance2 = e[..., 0] ** 2 + e[..., 1] ** 2 + e[..., 2] ** 2
    faces = -(cosine[..., 0] + cosine[..., 1] + cosine[..., 2]) >= min_cosine
    distance2[~faces | (distance2 >= max_distance**2)] = np.inf
    expected = np.where(distance2.min(axis=1) < np.inf, distance2.argmin(axis=1), -1)
    index = VoxelIndex(points, normals, edge and scale * edge)
    row, distance = index.nearest_facing(queries, beams, max_distance, min_cosine)
    np.testing.assert_array_equal(row, expected)
    np.testing.assert_array_equal(distance, np.sqrt(distance2.min(axis=1)))


def test_agrees_with_a_kd_tree_on_a_large_map_near_and_far():
    points, normals = wavy_cylinder(100_000, 1)
    rng = np.random.default_rng(2)
    queries = np.concatenate(
        [points[:3000] + rng.normal(0, 0.02, (3000, 3)), rng.uniform(-1, 1, (500, 3))]
    )
    index = VoxelIndex(points, normals)
    _, distance = index.nearest(queries)
    np.testing.assert_allclose(distance, cKDTree(points).query(queries)[0], rtol=1e-12)


def test_the_centre_of_a_sphere_where_every_point_is_a_candidate():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(20_000, 3))
    points *= 0.08 / np.linalg.norm(points, axis=1, keepdims=True)
    queries = rng.normal(0, 1e-3, (50, 3))
    _, distance = any_way(points).nearest(queries)
    np.testing.assert_allclose(distance, cKDTree(points).query(queries)[0], rtol=1e-12)


def test_of_equally_near_points_the_first_is_taken():
    axis = np.arange(-2.0, 3.0)
    lattice = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    points = np.random.default_rng(7).permutation(np.concatenate([lattice, lattice]))
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    queries = lattice[:40] + 0.5  # eight places are equally near, and two points are at each
    distance = np.linalg.norm(queries[:, None] - points[None], axis=2)
    expected = np.argmax(distance == distance.min(axis=1, keepdims=True), axis=1)
    for edge in (None, 0.5, 1.0, 10.0):
        index = VoxelIndex(points, normals, edge)
        np.testing.assert_array_equal(index.nearest(queries)[0], expected)
        np.testing.assert_array_equal(index.nearest_facing(queries, [0, 0, -1.0])[0], expected)


def test_one_index_serves_every_angle_of_incidence_and_every_distance():
    points, normals = wavy_cylinder(2000, 8)
    rng = np.random.default_rng(9)
    queries = points[:50] + rng.normal(0, 0.02, (50, 3))
    directions = -normals[:50]
    cosine = -np.einsum('qi,pi->qp', directions, normals)
    index = VoxelIndex(points, normals)
    for min_cosine, max_distance in ((0.9999, 0.1), (0.1, 0.02), (-0.5, np.inf), (0.9999, 0.5)):
        expected = brute_force(points, queries, max_distance, cosine >= min_cosine)
        _, distance = index.nearest_facing(queries, directions, max_distance, min_cosine)
        np.testing.assert_allclose(distance, expected, rtol=1e-12)


def test_a_nanometre_decides_900_m_from_the_corner():
    """Points a nanometre apart, and faces on the very limit of a beam."""
    rng = np.random.default_rng(12)
    cluster = np.array([900.0, -400.0, 300.0]) + 1e-9 * rng.integers(-500, 500, (200, 3))
    points = np.concatenate([cluster, [[0.0, 0.0, 0.0], [-900.0, 400.0, -300.0]]])
    tilt = rng.choice([-1e-9, 0.0, 1e-9], len(points))
    normals = np.column_stack([np.cos(tilt), np.sin(tilt), 0.0 * tilt])
    queries = cluster[:50] + 1e-7 * rng.normal(size=(50, 3))
    beams = np.tile([0.0, -1.0, 0.0], (50, 1))
    index = VoxelIndex(points, normals, edge=0.15)
    faces = -np.einsum('qi,pi->qp', beams, normals) >= 0.0
    for allowed, found in (
        (None, index.nearest(queries)),
        (faces, index.nearest_facing(queries, beams, 0.05, 0.0)),
    ):
        np.testing.assert_allclose(
            found[1], brute_force(points, queries, 0.05, allowed), rtol=1e-12
        )


def test_where_the_map_lies_changes_nothing():
    points, normals = wavy_cylinder(5000, 13)
    points = np.round(points * 2.0**20) / 2.0**20  # so that moving it does not round it
    rng = np.random.default_rng(14)
    queries = np.round((points[:500] + rng.normal(0, 0.02, (500, 3))) * 2.0**20) / 2.0**20
    away = np.array([2.0**21, -(2.0**20), 2.0**10])  # metres, as in a national grid
    here, there = VoxelIndex(points, normals), VoxelIndex(points + away, normals)
    for one, other in zip(here.nearest(queries), there.nearest(queries + away), strict=True):
        np.testing.assert_array_equal(one, other)


def test_places_far_from_a_map_find_what_is_nearest():
    """Farther than rings of blocks are worth looking at, inside the map's box and outside."""
    points, normals = wavy_cylinder(3000, 10)
    points = np.concatenate([points, [[40.0, -30.0, 20.0]]])
    normals = np.concatenate([normals, [[0.0, 0.0, 1.0]]])
    queries = np.random.default_rng(11).uniform(-60.0, 60.0, (300, 3))
    for edge in (None, 0.01):
        index = VoxelIndex(points, normals, edge)
        for max_distance in (5.0, np.inf):
            _, distance = index.nearest(queries, max_distance)
            expected = brute_force(points, queries, max_distance)
            np.testing.assert_allclose(distance, expected, rtol=1e-12)


def test_lookups_write_nothing_so_that_an_index_can_be_shared():
    points, normals = wavy_cylinder(1000, 6)
    index = VoxelIndex(points, normals)
    for array in index.arrays:
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    row, distance = index.nearest_facing(points[:50], -normals[:50], 0.1, 0.3)
    np.testing.assert_array_equal(row, np.arange(50))
    np.testing.assert_array_equal(distance, 0.0)


@pytest.mark.parametrize('query', [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 1e300]])
def test_a_query_that_is_no_place_has_no_neighbour(query):
    row, distance = any_way(np.zeros((1, 3)), 0.1).nearest(np.array([query]))
    assert row[0] == -1 and distance[0] == np.inf


def test_max_distance_is_a_strict_limit():
    index = any_way(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert index.nearest(np.array([[0.25, 0.0, 0.0]]), 0.25)[0][0] == -1
    assert index.nearest(np.array([[0.25, 0.0, 0.0]]), 0.2500001)[0][0] == 0


@pytest.mark.parametrize(
    ('points', 'said'),
    [
        (np.empty((0, 3)), r'\(N, 3\)'),
        (np.zeros((4, 2)), r'\(4, 2\)'),
        (np.array([[0, 0, 0], [0, np.nan, 0.0]]), 'first is number 1'),
    ],
)
def test_unusable_points_are_refused_by_name(points, said):
    with pytest.raises(MapError, match=f'points.*{said}'):
        VoxelIndex(points, np.ones((4, 3)))
    with pytest.raises(MapError, match=f'normals.*{said}'):
        VoxelIndex(np.ones((4, 3)), points)


def test_each_point_needs_its_normal():
    with pytest.raises(MapError, match=r'normals \(1, 3\) must match points \(2, 3\)'):
        VoxelIndex(np.zeros((2, 3)), np.ones((1, 3)))


@pytest.mark.parametrize(
    ('points', 'edge', 'said'),
    [
        ([[0.0, 0, 0], [2e9, 0, 0]], None, 'at most 1e'),
        ([[0.0, 0, 0]], 0.0, 'edge must be > 0'),
        ([[0.0, 0, 0]], np.inf, 'edge must be > 0'),
        ([[0.0, 0, 0], [1e4, 0, 0]], 1e-4, 'too small'),
    ],
)
def test_unusable_sizes_are_refused(points, edge, said):
    with pytest.raises(MapError, match=said):
        any_way(np.array(points), edge)


@pytest.mark.parametrize('shape', [(3,), (4, 2)])
def test_queries_of_another_shape_are_refused(shape):
    index = any_way(np.zeros((1, 3)))
    for ask in (index.nearest, lambda q: index.nearest_facing(q, [0.0, 0.0, 1.0])):
        with pytest.raises(MapError, match='queries must be'):
            ask(np.zeros(shape))


def test_directions_of_another_shape_are_refused():
    with pytest.raises(MapError, match=r'directions must be \(4, 3\).*got \(2, 3\)'):
        any_way(np.zeros((1, 3))).nearest_facing(np.zeros((4, 3)), np.ones((2, 3)))


def test_a_map_is_indexed_once_for_filter_scene_and_rehearsal(monkeypatch):
    """Every index of a cloud as large as the map counts; that of a search is of a thinned one."""
    made = []
    build = VoxelIndex.__init__

    def counted(self, points, *arguments):
        made.append(len(points))
        build(self, points, *arguments)

    monkeypatch.setattr(VoxelIndex, '__init__', counted)
    robot, prior = rod(), room_map()
    settings = parse_settings(EstimatorSettings, {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2})
    scene = SeenScene(robot, prior, 5.0)
    warm_up(robot, prior, settings, scene)
    estimator = SlidingWindowFilter(robot, prior, settings)
    assert made.count(len(prior)) == 1
    assert estimator.setup.surface.lookup is prior.index.arrays
