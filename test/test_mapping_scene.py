"""
Reconstruction and anomalies.

Covariance against Monte Carlo, detection in rooms whose differences are known.
"""

from dataclasses import replace

from continuum_loc import lie
from continuum_loc.errors import MapError
from continuum_loc.mapping.build import sample_mesh
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import TofFrame
from continuum_loc.robot import load_robot
from continuum_loc.scene.anomalies import (
    AnomalyCluster,
    AnomalySettings,
    Beams,
    beams_on,
    clusters,
    detect_anomalies,
    Evidence,
    mahalanobis2,
    missing_evidence,
    new_evidence,
    precision_recall,
    seen,
    Truth,
    unexplained_share,
    wilson_lower_bound,
)
from continuum_loc.scene.free_space import passes
from continuum_loc.scene.fuse import fuse
from continuum_loc.scene.reconstruct import (
    distances_to_mesh,
    reconstruct,
    Reconstruction,
    root_mean_square,
)
from continuum_loc.scene.splat_cast import first_crossings
from continuum_loc.trajectory import BASE, Trajectory
import numpy as np
import pytest
from scipy import stats
import trimesh

ROBOT = load_robot('soft_arm')
FRAMES = 40
WIDE = AnomalySettings(cell=0.03)
PERIOD = 66_666_667  # ns


def room(*objects):
    walls = trimesh.creation.box((0.7, 0.7, 0.6))
    walls.invert()
    walls.apply_translation((0, 0, 0.3))
    return trimesh.util.concatenate([walls, *objects])


def placed(mesh, *centre):
    mesh.apply_translation(centre)
    return mesh


NAMES = (BASE, *ROBOT.ring_names)

BALL = placed(trimesh.creation.icosphere(subdivisions=3, radius=0.05), 0.2, 0.1, 0.2)
CUBE = placed(trimesh.creation.box((0.08, 0.08, 0.12)), -0.22, -0.1, 0.06)
COMMON = placed(trimesh.creation.box((0.1, 0.1, 0.2)), 0.1, -0.22, 0.1)


def swaying(covariance=None):
    """Bend the arm that hangs in the room to and fro."""
    poses = np.empty((FRAMES, 4, 4, 4))
    for k in range(FRAMES):
        poses[k, 0] = ROBOT.base.T_map_base
        for i, ds in enumerate(np.diff([0, *ROBOT.ring_arclengths])):
            bend = 0.5 * np.array([np.sin(k / 7), np.cos(k / 9)])
            poses[k, i + 1] = poses[k, i] @ lie.exp(np.array([0.75 * ds, 0, 0, 0, *bend]))
    return Trajectory(np.arange(FRAMES) * PERIOD, NAMES, poses, covariance)


def measured(trajectory, mesh, seed=0, noise=True):
    """Cast ToF frames of the paper's noise into the mesh from the true poses."""
    import open3d

    rng, zones = np.random.default_rng(seed), ROBOT.tof_model.directions
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    frames = []
    for stamp, T_map_ring in zip(trajectory.stamps, trajectory.T_map_ring, strict=True):
        for sensor in ROBOT.tof:
            T = T_map_ring[ROBOT.ring_names.index(sensor.ring) + 1] @ sensor.mount.T_ring_sensor
            rays = np.column_stack(
                [np.tile(T[:3, 3], (len(zones), 1)), zones @ T[:3, :3].T]
            ).astype(np.float32)
            ranges = scene.cast_rays(rays, nthreads=1)['t_hit'].numpy().astype(float)
            sigma = ROBOT.tof_model.sigma(ranges)
            ranges += noise * sigma * rng.normal(size=len(zones))
            frames.append(
                TofFrame(
                    int(stamp),
                    sensor.name,
                    ranges[:, None] * zones,
                    ranges,
                    sigma,
                    np.full(len(zones), 5, np.uint8),
                )
            )
    return frames


@pytest.fixture(scope='module')
def changed_room():
    """(trajectory, frames, map): the map has the cube, the room has the ball."""
    trajectory = swaying()
    map_mesh = room(CUBE, COMMON)
    prior = sample_mesh(map_mesh.vertices, map_mesh.faces, spacing=0.005)
    return trajectory, measured(trajectory, room(BALL, COMMON)), prior


def test_without_noise_every_point_lies_on_the_mesh():
    mesh, trajectory = room(COMMON), swaying()
    cloud = reconstruct(ROBOT, measured(trajectory, mesh, noise=False), trajectory)
    assert len(cloud.points) + cloud.on_body == FRAMES * len(ROBOT.tof) * 64
    assert root_mean_square(cloud.distances_to_mesh(mesh.vertices, mesh.faces)) < 1e-6


def test_covariance_matches_monte_carlo():
    """
    Draw poses and ranges as the covariances state them.

    The scatter of the points is eq. 11's (5 % of its norm).
    """
    rng = np.random.default_rng(1)
    root = np.diag([0.004, 0.003, 0.005, 0.01, 0.02, 0.015]) @ (
        np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    )
    covariance = root @ root.T
    base = swaying()
    trajectory = Trajectory(
        base.stamps[:2], NAMES, base.T_map_ring[:2], np.tile(covariance, (2, 4, 1, 1))
    )
    frame = measured(base, room(), noise=False)[4]
    cloud = reconstruct(ROBOT, [frame], trajectory, floor=0.0, body_margin=-ROBOT.radius)
    sensor = ROBOT.sensor(frame.sensor)
    T_map_ring = base.T_map_ring[0, ROBOT.ring_names.index(sensor.ring) + 1]
    draws = 40_000
    T = T_map_ring @ lie.exp(rng.normal(size=(draws, 6)) @ root.T) @ sensor.mount.T_ring_sensor
    for zone in (0, 27, 63):
        ranges = frame.ranges[zone] + frame.sigma[zone] * rng.normal(size=(draws, 1))
        points = (
            np.einsum('nij,nj->ni', T[:, :3, :3], ranges * ROBOT.tof_model.directions[zone])
            + T[:, :3, 3]
        )
        error = np.linalg.norm(np.cov(points.T) - cloud.covariance[zone]) / np.linalg.norm(
            cloud.covariance[zone]
        )
        assert error < 0.05


def test_points_are_consistent_with_their_covariance():
    """
    Normalised distances to a plane have unit variance.

    The plane is the floor of the room, at 0.1 % false alarms.
    """
    trajectory = swaying()
    cloud = reconstruct(ROBOT, measured(trajectory, room(), seed=2), trajectory, floor=1e-6)
    down = (cloud.origins - cloud.points)[:, 2] > 0.9 * np.linalg.norm(
        cloud.origins - cloud.points, axis=1
    )
    on_floor = down & (np.abs(cloud.points[:, :2]).max(axis=1) < 0.3)
    z = cloud.points[on_floor, 2] / np.sqrt(cloud.covariance[on_floor, 2, 2])
    assert len(z) > 300
    low, high = stats.chi2(len(z)).ppf([0.0005, 0.9995])
    assert low < np.sum(z**2) < high


def test_zones_that_see_the_robot_itself_are_dropped_and_counted():
    trajectory = swaying()
    frame = measured(trajectory, room(), noise=False)[0]
    T_ring_sensor = ROBOT.sensor(frame.sensor).mount.T_ring_sensor
    points = frame.points.copy()
    # Beside the backbone.
    points[:5] = (lie.inverse(T_ring_sensor) @ np.array([-0.05, 0.0, 0.03, 1.0]))[:3]
    touched = TofFrame(frame.stamp, frame.sensor, points, frame.ranges, frame.sigma, frame.status)
    cloud = reconstruct(ROBOT, [touched], trajectory)
    assert cloud.on_body == 5 and len(cloud.points) == 59


def test_frames_outside_the_trajectory_are_counted_and_strange_ones_refused():
    trajectory = swaying()
    frames = measured(trajectory, room())
    half = Trajectory(trajectory.stamps[:20], NAMES, trajectory.T_map_ring[:20])
    assert reconstruct(ROBOT, frames, half).skipped == 20 * len(ROBOT.tof)
    late = TofFrame(
        10**12,
        frames[0].sensor,
        *(getattr(frames[0], n) for n in ('points', 'ranges', 'sigma', 'status')),
    )
    with pytest.raises(MapError, match='none of the 1 ToF frames'):
        reconstruct(ROBOT, [late], trajectory)
    other = TofFrame(
        0, 'nose_tof', *(getattr(frames[0], n) for n in ('points', 'ranges', 'sigma', 'status'))
    )
    with pytest.raises(MapError, match='nose_tof.*ring1_tof1'):
        reconstruct(ROBOT, [other], trajectory)


def test_a_reconstruction_is_saved_with_sigma_and_flags(tmp_path):
    import open3d

    trajectory = swaying()
    cloud = reconstruct(ROBOT, measured(trajectory, room())[:9], trajectory)
    cloud.save(tmp_path / 'scene.ply', anomaly=np.arange(len(cloud.points)) % 2)
    read = open3d.t.io.read_point_cloud(str(tmp_path / 'scene.ply')).point
    np.testing.assert_array_equal(read.positions.numpy(), cloud.points)
    np.testing.assert_allclose(read.sigma.numpy().ravel(), cloud.sigma, rtol=1e-6)
    assert read.anomaly.numpy().sum() == len(cloud.points) // 2


def test_rays_cross_the_mapped_surface_where_they_cross_the_mesh():
    sphere = trimesh.creation.icosphere(subdivisions=5)
    prior = sample_mesh(sphere.vertices, sphere.faces, spacing=0.02)
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = -2.0 * directions + 0.3 * rng.normal(size=(2000, 3))
    closest = np.einsum('ij,ij->i', origins, directions)
    miss = np.linalg.norm(origins - closest[:, None] * directions, axis=1)
    depth = -closest - np.sqrt(np.maximum(1.0 - miss**2, 0.0))
    row, found = first_crossings(prior, origins, directions, np.full(2000, 5.0))
    inside = miss < 0.9
    assert np.mean(row[inside] >= 0) > 0.99
    hit = inside & (row >= 0)
    # A disc of radius r stands off a unit sphere by r^2 / 2 at most, seen at a cosine of at least
    # 0.43.
    assert np.abs(found - depth)[hit].max() < 2.0 * 0.02**2 / 2 / 0.43 + 1e-3
    assert np.all(row[miss > 1.03] == -1)


def test_new_and_missing_things_are_found_and_nothing_else(changed_room):
    trajectory, frames, prior = changed_room
    cloud = reconstruct(ROBOT, frames, trajectory)
    detected = detect_anomalies(cloud, prior)
    assert sorted(cluster.kind for cluster in detected) == ['added', 'missing']
    truth = [
        Truth('added', BALL.vertices, BALL.faces),
        Truth('missing', CUBE.vertices, CUBE.faces),
    ]
    assert seen(truth, cloud) == truth
    result = precision_recall(detected, truth, [0.0, 0.5, 0.9])
    np.testing.assert_array_equal(result.precision, 1.0)
    np.testing.assert_array_equal(result.recall, 1.0)
    for cluster in detected:
        assert 0.05 < cluster.size < 0.2


def test_beams_that_end_beside_a_thing_do_not_show_it():
    tile = placed(trimesh.creation.box((0.1, 0.1, 0.01)), 0, 0, 0.005)
    truth = Truth('added', tile.vertices, tile.faces)
    ends = np.array([[0.0, 0.0, 0.01], [0.03, 0.0, 0.012], [0.055, 0.0, 0.0], [0.0, 0.0, 0.3]])
    count = len(ends)
    cloud = Reconstruction(
        ends,
        np.tile(np.eye(3) * 1e-6, (count, 1, 1)),
        np.full(count, 0.001),
        np.column_stack([ends[:, :2], np.full(count, 0.5)]),
        np.arange(count),
        np.zeros(count, int),
        ('tof',),
        np.empty((0, 3)),
        np.empty((0, 3)),
    )
    # The third ends on the floor 5 mm beside it, the fourth on something before it.
    assert beams_on(truth, cloud) == 2
    cloud = replace(cloud, points=ends - [0.0, 0.0, 0.05])
    assert beams_on(truth._replace(kind='missing'), cloud) == 2  # those that go through


def test_an_unchanged_room_has_no_anomalies():
    trajectory, mesh = swaying(), room(COMMON)
    prior = sample_mesh(mesh.vertices, mesh.faces, spacing=0.005)
    assert (
        detect_anomalies(reconstruct(ROBOT, measured(trajectory, mesh, seed=4), trajectory), prior)
        == []
    )


def test_points_on_the_map_pass_the_chi2_test_at_its_level():
    """
    Eq. 12 with Sigma_nn of the sampling.

    Points of the surface exceed the 1 % quantile of chi2(3) in at most 2 %.
    """
    trajectory, mesh = swaying(), room()
    prior = sample_mesh(mesh.vertices, mesh.faces, spacing=0.01)
    cloud = reconstruct(ROBOT, measured(trajectory, mesh, seed=5), trajectory)
    distance2, _ = mahalanobis2(cloud, prior, 0.3)
    assert np.mean(distance2 > stats.chi2(3).ppf(0.99)) < 0.02
    assert np.mean(distance2) > 0.5  # nor is the covariance so wide that nothing could ever be new


def flat_map(sigma: float, reach: float = 0.4, spacing: float = 0.02):
    """Map the plane z = 0, whose normal looks up."""
    ticks = np.arange(-reach, reach, spacing)
    points = np.stack([*(a.ravel() for a in np.meshgrid(ticks, ticks)), np.zeros(len(ticks) ** 2)])
    normals = np.tile([0.0, 0.0, 1.0], (points.shape[1], 1))
    return PriorMap(points.T, normals, np.ones(points.shape[1]), sigma, spacing)


def looking_down(heights: np.ndarray, sigma: float) -> Reconstruction:
    """One beam from 0.5 m above the map's points to each height, known to `sigma` all round."""
    count = len(heights)
    ends = np.column_stack([0.02 * np.arange(count) - 0.1, np.zeros(count), heights])
    return Reconstruction(
        ends,
        np.tile(np.eye(3) * sigma**2, (count, 1, 1)),
        np.full(count, sigma),
        np.column_stack([ends[:, :2], np.full(count, 0.5)]),
        np.arange(count),
        np.zeros(count, int),
        ('tof',),
        np.empty((0, 3)),
        np.empty((0, 3)),
    )


def test_a_point_is_new_beyond_three_of_its_standard_deviations():
    """
    Eq. 12 as it comes: 4 mm of the range and 3 mm of the map are 5 mm, so that 15 mm is the bound.

    Nothing nearer than 1 cm is new, however well it is known.
    """
    cloud, prior = looking_down(np.array([0.0, 0.0145, 0.0155, 0.018]), 0.004), flat_map(0.003)
    distance2, _ = mahalanobis2(cloud, prior, 0.3)
    np.testing.assert_allclose(distance2, [0.0, 2.9**2, 3.1**2, 3.6**2], atol=1e-9)
    evidence = new_evidence(cloud, prior, AnomalySettings())
    assert evidence.disagrees.tolist() == [False, False, True, True]
    sure = looking_down(np.array([0.0095, 0.0105]), 0.0004), flat_map(0.0003)
    found = new_evidence(*sure, AnomalySettings())
    assert found.disagrees.tolist() == [False, True]


def test_a_beam_is_through_the_map_beyond_three_of_its_standard_deviations():
    """The same 15 mm: one that ends 14.5 mm behind the surface still agrees with it."""
    cloud, prior = looking_down(np.array([-0.0145, -0.0155, -0.2]), 0.004), flat_map(0.003)
    beams, settings = Beams.of(cloud), AnomalySettings()
    np.testing.assert_allclose(beams.margin(prior, settings), 0.015, rtol=1e-9)
    evidence = missing_evidence(beams, prior, settings)
    assert evidence.disagrees.tolist() == [False, True, True]
    sure = Beams.of(looking_down(np.array([0.0]), 0.0001))
    np.testing.assert_allclose(sure.margin(flat_map(0.0001), settings), 0.01)


def test_witnesses_to_the_contrary_lower_the_confidence():
    rng = np.random.default_rng(6)
    places, stamps = rng.uniform(0, 0.03, (60, 3)), np.arange(60)
    alone = clusters(Evidence(places, np.ones(60, bool), stamps, np.arange(60)), 'added', WIDE)
    disputed = clusters(
        Evidence(places, np.arange(60) % 3 > 0, stamps, np.arange(60)), 'added', WIDE
    )
    denied = clusters(
        Evidence(places, np.arange(60) % 3 == 0, stamps, np.arange(60)), 'added', WIDE
    )
    assert alone[0].confidence > 0.9 > disputed[0].confidence > 0.4 and denied == []
    one_frame = clusters(
        Evidence(places, np.ones(60, bool), np.zeros(60), np.arange(60)), 'added', WIDE
    )
    assert one_frame == []


@pytest.mark.parametrize(
    ('kind', 'x', 'length', 'explained'),
    [
        ('missing', 0.0, 0.795, False),  # through the middle of a plate, to the wall behind it
        ('missing', 0.105, 0.795, True),  # past its edge, which the discs overhang
        ('added', 0.0, 0.3, False),  # ends in mid-air
        ('added', 0.105, 0.495, True),  # at the height of the plate, where it might not have ended
        ('added', 0.14, 0.495, False),  # too far beside it for that
    ],
)
def test_what_an_edge_of_the_map_explains_is_no_anomaly(kind, x, length, explained):
    plate = placed(trimesh.creation.box((0.2, 0.2, 0.01)), 0, 0, 0)
    wall = placed(trimesh.creation.box((1.0, 1.0, 0.01)), 0, 0, -0.3)
    mesh = trimesh.util.concatenate([plate, wall])
    prior = sample_mesh(mesh.vertices, mesh.faces, spacing=0.02, seed=1)
    count = 20
    beams = Beams(
        np.column_stack([np.full(count, x), np.linspace(-0.05, 0.05, count), np.full(count, 0.5)]),
        np.tile([0.0, 0.0, -1.0], (count, 1)),
        np.full(count, length),
        np.full(count, 0.001),
        np.arange(count),
    )
    cluster = AnomalyCluster(
        kind, np.zeros((count, 3)), np.zeros(3), np.zeros(3), count, count, 1.0, np.arange(count)
    )
    settings = AnomalySettings()
    share = unexplained_share(cluster, beams, prior, settings)
    # Discs leave holes of 3 %, and one in any of a beam's seven lines explains it.
    assert share < 0.1 if explained else share > 0.97**7 - 0.15


def test_a_small_cluster_needs_many_beams():
    def found(beams, width):
        places = np.random.default_rng(8).uniform(0, width, (beams, 3))
        agreed = Evidence(places, np.ones(beams, bool), np.arange(beams), np.arange(beams))
        return len(clusters(agreed, 'missing', AnomalySettings(cell=0.1)))

    assert [found(49, 0.02), found(50, 0.02), found(49, 0.04)] == [0, 1, 1]


def test_wilson_bound_covers_the_true_share_as_often_as_it_says():
    """
    One-sided 95 %: the bound exceeds the truth in about 5 % of 4000 draws.

    False alarm of this test is below 1e-6.
    """
    draws = np.random.default_rng(7).binomial(40, 0.8, 4000)
    above = np.mean([wilson_lower_bound(k, 40, 1.645) > 0.8 for k in draws])
    assert above < 0.09


def test_precision_and_recall_count_kind_and_place(changed_room):
    trajectory, frames, prior = changed_room
    detected = detect_anomalies(reconstruct(ROBOT, frames, trajectory), prior)
    swapped = [
        Truth('missing', BALL.vertices, BALL.faces),
        Truth('added', CUBE.vertices, CUBE.faces),
    ]
    result = precision_recall(detected, swapped, [0.0])
    assert result.precision[0] == 0.0 and result.recall[0] == 0.0
    nothing_kept = precision_recall(detected, swapped, [1.1])
    assert nothing_kept.precision[0] == 1.0 and nothing_kept.recall[0] == 0.0


def test_fused_surfels_are_nearer_to_the_surface_than_points_and_say_how_near():
    """Averaging over the beams of a surfel leaves less than half of a range's error."""
    trajectory, mesh = swaying(), room(COMMON)
    cloud = reconstruct(ROBOT, measured(trajectory, mesh, seed=8), trajectory)
    scene = fuse(cloud)
    off = distances_to_mesh(scene.points, mesh.vertices, mesh.faces)
    raw = cloud.distances_to_mesh(mesh.vertices, mesh.faces)
    assert len(scene.points) < len(cloud.points)
    assert np.median(off) < 0.5 * np.median(raw)
    assert root_mean_square(off) < 0.75 * root_mean_square(raw)
    assert np.mean(off <= 3.0 * scene.sigma) > 0.85
    assert np.linalg.eigvalsh(scene.covariance).min() > 0.0
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1.0)


def test_a_pose_error_that_all_beams_share_does_not_average_out():
    covariance = np.zeros((FRAMES, 4, 6, 6))
    covariance[:, :, :3, :3] = 0.005**2 * np.eye(3)
    trajectory = swaying(covariance)
    scene = fuse(reconstruct(ROBOT, measured(trajectory, room(), seed=9), trajectory))
    assert scene.sigma.min() >= 0.005


def test_a_fused_scene_survives_its_file(tmp_path):
    import open3d

    trajectory = swaying()
    scene = fuse(reconstruct(ROBOT, measured(trajectory, room())[:90], trajectory))
    scene.save(tmp_path / 'scene.ply')
    read = open3d.t.io.read_point_cloud(str(tmp_path / 'scene.ply')).point
    np.testing.assert_array_equal(read.positions.numpy(), scene.points)
    np.testing.assert_allclose(read.sigma.numpy().ravel(), scene.sigma, rtol=1e-5)


def test_a_beam_passes_the_cells_that_it_enters_and_leaves():
    """Against the slab test on every cell."""
    rng = np.random.default_rng(10)
    edge, cells = 0.1, np.unique(rng.integers(-6, 6, (300, 3)), axis=0)
    origins, ends = rng.uniform(-0.9, 0.9, (2, 400, 3))
    lengths = np.linalg.norm(ends - origins, axis=1)
    directions = (ends - origins) / lengths[:, None]
    sides = (edge * (cells[None, :, None] + np.arange(2)[:, None]) - origins[:, None, None]) / (
        directions[:, None, None]
    )
    enters, leaves = sides.min(axis=2).max(axis=-1), sides.max(axis=2).min(axis=-1)
    through = (enters < leaves) & (leaves > 0.0) & (leaves < lengths[:, None])
    counted = passes(cells, edge, origins, directions, lengths)
    np.testing.assert_array_equal(counted, through.sum(axis=0))
    assert counted.sum() > 100


def test_what_a_missing_thing_has_laid_open_is_no_new_thing():
    """The floor under the cube is not in the map of the room with the cube on it."""
    trajectory = swaying()
    filled = trimesh.creation.box((0.7, 0.7, 0.6))
    filled.apply_translation((0, 0, 0.3))
    free = filled.difference(CUBE)
    free.invert()
    prior = sample_mesh(free.vertices, free.faces, spacing=0.01)
    cloud = reconstruct(ROBOT, measured(trajectory, room(), seed=11), trajectory)
    kinds = {cluster.kind for cluster in detect_anomalies(cloud, prior, WIDE)}
    assert kinds == {'missing'}
