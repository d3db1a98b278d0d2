"""
The simulated world is consistent with itself.

Every sensor agrees with the truth, and seeds decide everything.
"""

from collections import Counter, defaultdict
import dataclasses
import hashlib
import os
from pathlib import Path
import re
import subprocess
import sys

from continuum_loc import lie
from continuum_loc.errors import SettingsError
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    NANOSECONDS,
    seconds,
    StrainSample,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from continuum_loc.robot import load_robot, Sensor
from continuum_loc.simulator import faults
from continuum_loc.simulator.model import GRAVITY
from continuum_loc.simulator.motion import backbone, Motion, State
from continuum_loc.simulator.plant import load_plant
from continuum_loc.simulator.sensors import HallSensors, ImuSensors, StrainSensor
from continuum_loc.simulator.trajectories import Drive, trajectory, trajectory_names
from continuum_loc.simulator.world import World
import numpy as np
import pytest
from scipy import stats

FALSE_ALARM = 1e-3  # of each statistical test; the seeds are fixed, so a pass stays a pass


def quiet(robot):
    """Quieten the robot: its sensors add next to nothing to the truth."""
    imu = robot.imu_model.model_copy(
        update={'gyro_sigma': 1e-12, 'accel_sigma': 1e-12, 'gyro_bias_sigma': 0.0}
    )
    strain = robot.strain and robot.strain.model_copy(
        update={'kappa_sigma': 1e-12, 'theta_sigma': 1e-12}
    )
    hall = robot.hall_model.model_copy(update={'sigma': 1e-15, 'lsb': (1e-12, 1e-12, 1e-12)})
    insertion = robot.base.insertion.model_copy(update={'sigma': 1e-12})
    base = robot.base.model_copy(update={'insertion': insertion})
    return robot.model_copy(
        update={'imu_model': imu, 'strain': strain, 'hall_model': hall, 'base': base}
    )


@dataclasses.dataclass
class Recording:
    """Samples of one run by type, and the true backbone at each truth stamp."""

    samples: list
    nodes: np.ndarray
    nodes_s: np.ndarray

    def of(self, kind, sensor=None):
        return [
            s for s in self.samples if type(s) is kind and (sensor is None or s.sensor == sensor)
        ]


def record(world, duration):
    samples, nodes = [], []
    for sample in world.run(duration):
        samples.append(sample)
        if type(sample) is TruthSample:
            nodes.append(world.full_state(world.nodes_s))
    return Recording(samples, np.array(nodes), world.nodes_s)


@pytest.fixture(scope='module')
def engine():
    """Six seconds of the engine robot in empty space, without noise."""
    return record(World(quiet(load_robot('engine')), None, 't2'), 6.0)


@pytest.fixture(scope='module')
def truth(engine):
    return np.array([sample.T_map_ring for sample in engine.of(TruthSample)])


def test_stamps_never_go_back_and_every_sensor_keeps_its_rate(engine):
    stamps = [sample.stamp for sample in engine.samples]
    assert stamps[0] == NANOSECONDS and np.all(np.diff(stamps) >= 0)
    counts = Counter(type(sample).__name__ for sample in engine.samples)
    assert counts == {
        'TruthSample': 600,
        'ImuSample': 5 * 600,
        'StrainSample': 120,
        'EncoderSample': 300,
    }
    imu = np.array([sample.stamp for sample in engine.of(ImuSample, 'ring3_imu')])
    np.testing.assert_array_equal(imu, NANOSECONDS + np.arange(600) * 10_000_000)


def test_the_first_second_is_at_rest_and_then_the_tip_sweeps_decimetres(truth):
    first = truth[:100, :, :3, 3]
    assert np.ptp(first, axis=0).max() < 1e-4
    assert np.ptp(truth[100:, -1, :3, 3], axis=0).max() > 0.2


def test_gyros_are_the_derivative_of_the_true_rotation(engine, truth):
    """Over a sampling interval the mean of two samples is the chord but for second-order terms."""
    for ring in (1, 3, 5):
        gyro = np.array([s.angular_velocity for s in engine.of(ImuSample, f'ring{ring}_imu')])
        chord = (
            lie.so3_log(np.swapaxes(truth[:-1, ring, :3, :3], -1, -2) @ truth[1:, ring, :3, :3])
            / 0.01
        )
        error = (gyro[:-1] + gyro[1:]) / 2.0 - chord
        assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(chord**2))


def test_accelerometers_read_the_second_derivative_of_position_plus_gravity(engine, truth):
    R, p = truth[:, 5, :3, :3], truth[:, 5, :3, 3]
    second = (p[2:] - 2.0 * p[1:-1] + p[:-2]) / 0.01**2 + [0.0, 0.0, GRAVITY]
    expected = np.einsum('kab,ka->kb', R[1:-1], second)
    read = np.array([s.linear_acceleration for s in engine.of(ImuSample, 'ring5_imu')])[1:-1]
    assert np.sqrt(np.mean((read - expected) ** 2)) < 0.1  # the two differences span 10 and 20 ms


def test_accelerometers_at_rest_read_g_upwards(engine, truth):
    for ring in range(1, 6):
        read = np.mean(
            [s.linear_acceleration for s in engine.of(ImuSample, f'ring{ring}_imu')[:90]], axis=0
        )
        np.testing.assert_allclose(truth[0, ring, :3, :3] @ read, [0.0, 0.0, GRAVITY], atol=5e-3)


def test_insertion_encoder_is_the_travel_of_the_base(engine, truth):
    encoders = engine.of(EncoderSample)
    read = np.array([sample.position[sample.names.index('insertion')] for sample in encoders])
    base = load_robot('engine').base
    np.testing.assert_allclose(truth[::2, 0, 0, 3] - base.xyz[0], read, atol=1e-9)
    assert read[-1] > 0.2
    np.testing.assert_allclose(
        truth[:, 0, 1:3, 3], np.broadcast_to(base.xyz[1:], (600, 2)), atol=1e-12
    )


def test_insertion_follows_its_command(engine, truth):
    command = trajectory('t2', load_robot('engine'), load_plant('engine'))
    commanded = [command.command(0.01 * k).insertion for k in range(600)]
    np.testing.assert_allclose(
        truth[:, 0, 0, 3] - load_robot('engine').base.xyz[0], commanded, atol=2e-3
    )


def test_tendon_encoders_are_the_change_of_their_channels_length(engine):
    """A channel at offset r is shorter by the integral of r x curvature along the backbone."""
    plant = load_plant('engine')
    group = plant.tendons[1]
    last = int(np.argmin(np.abs(engine.nodes_s - group.end)))
    shape = engine.nodes[::2][250]
    bend = lie.log(lie.inverse(shape[:last]) @ shape[1:][:last])[:, 3:]
    for k, azimuth in enumerate(np.radians(group.azimuth_deg)):
        offset = group.radius * np.array([0.0, np.cos(azimuth), np.sin(azimuth)])
        expected = np.cross(bend, offset)[:, 0].sum()
        sample = engine.of(EncoderSample)[250]
        read = sample.position[sample.names.index(f'tendon2_{k + 1}')]
        assert read == pytest.approx(expected, abs=4e-4)  # encoder noise is 0.1 mm


def test_integrated_strain_reproduces_the_rings(engine, truth):
    """
    From the base, the reported curvature alone leads to every ring.

    It is held for the spacing round each station.
    """
    robot = load_robot('engine')
    for index in (0, 60, 119):
        sample = engine.of(StrainSample)[index]
        bend = sample.kappa[:, None] * np.stack(
            [np.zeros_like(sample.theta), -np.sin(sample.theta), np.cos(sample.theta)], axis=-1
        )
        xi = robot.strain.spacing * np.column_stack(
            [np.ones(len(bend)), np.zeros((len(bend), 2)), bend]
        )
        T, at = truth[5 * index, 0], {}
        for k, step in enumerate(lie.exp(xi), start=1):
            T = T @ step
            at[round(k * robot.strain.spacing, 3)] = T
        for ring, s in enumerate(robot.ring_arclengths, start=1):
            difference = at[round(s, 3)][:3, 3] - truth[5 * index, ring, :3, 3]
            assert np.linalg.norm(difference) < 0.01 * s


def test_full_state_passes_through_the_rings_with_the_tangent_along_x(engine, truth):
    robot = load_robot('engine')
    shape = backbone(engine.nodes[400], engine.nodes_s, robot.ring_arclengths)
    np.testing.assert_allclose(shape, truth[400, 1:], atol=1e-9)
    s = np.linspace(0.0, robot.length, 3001)
    dense = backbone(engine.nodes[400], engine.nodes_s, s)
    chords = np.diff(dense[:, :3, 3], axis=0)
    assert np.linalg.norm(chords, axis=1).sum() == pytest.approx(robot.length, rel=2e-3)
    assert (
        np.einsum(
            'ka,ka->k', chords / np.linalg.norm(chords, axis=1)[:, None], dense[:-1, :3, 0]
        ).min()
        > 0.9999
    )
    with pytest.raises(ValueError, match='arclength must lie in'):
        backbone(engine.nodes[400], engine.nodes_s, 1.6)


# ------------------------------------------------------------------------ motion between the steps


def helix(time):
    """Move a frame in screw motion: its body twist is constant, its pose known at every time."""
    twist = np.array([0.3, -0.1, 0.2, 1.0, -2.0, 0.5])
    return lie.exp(time * twist), twist


def motion_of(pose, step):
    motion = Motion()
    for k in range(-1, 3):
        motion.append(State(k * step, pose(k * step)[None], 0.0, np.zeros(0), np.zeros(0)))
    return motion


def test_a_screw_motion_is_interpolated_exactly():
    motion = motion_of(lambda t: helix(t)[0], 0.01)
    frames = motion.frames(np.array([0]), np.eye(4))
    for time in np.linspace(0.0, 0.0099, 7):
        pose, twist, _ = motion.kinematics(time, frames)
        np.testing.assert_allclose(pose[0], helix(time)[0], atol=1e-12)
        np.testing.assert_allclose(twist[0], helix(time)[1], atol=1e-9)


def test_velocity_is_the_derivative_of_the_interpolated_pose():
    def wobble(t):
        return lie.exp(
            np.array([np.sin(8 * t), t * t, 0.1, 0.5 * np.sin(9 * t), np.cos(5 * t), t])
        )

    motion, d = motion_of(wobble, 0.02), 1e-6
    frames = motion.frames(np.array([0]), np.eye(4))
    for time in (0.003, 0.01, 0.0171):
        before, after = (motion.kinematics(time + e, frames)[0][0] for e in (-d, d))
        difference = lie.log(lie.inverse(before) @ after) / (2 * d)
        np.testing.assert_allclose(motion.kinematics(time, frames)[1][0], difference, atol=1e-7)


def test_motion_outside_the_stored_steps_is_refused():
    with pytest.raises(ValueError, match='outside the stored interval'):
        motion_of(lambda t: helix(t)[0], 0.01).pose(0.05)


# --------------------------------------------------------------------------- seeds and noise


def arrays(sample):
    return [getattr(sample, f.name) for f in dataclasses.fields(sample)]


def same(a, b):
    return type(a) is type(b) and all(
        np.asarray(x).tobytes() == np.asarray(y).tobytes() if isinstance(x, np.ndarray) else x == y
        for x, y in zip(arrays(a), arrays(b), strict=True)
    )


@pytest.fixture(scope='module')
def scene():
    from continuum_loc.simulator.scenes import load_scene

    return load_scene('S0')


def test_the_same_seed_gives_the_same_samples_to_the_bit(scene):
    robot = load_robot('engine')
    world = World(robot, scene, 't1', seed=3)
    runs = [
        list(world.run(0.5)),
        list(world.run(0.5)),
        list(World(robot, scene, 't1', seed=3).run(0.5)),
    ]
    assert len(runs[0]) > 300 and any(type(sample) is TofFrame for sample in runs[0])
    for other in runs[1:]:
        assert len(other) == len(runs[0]) and all(
            same(a, b) for a, b in zip(runs[0], other, strict=True)
        )


def test_another_process_makes_the_same_samples_to_the_bit():
    """A process of its own, with other hash seeds and another number of threads."""
    code = (
        'import sys; sys.path.insert(0, sys.argv[1]); import test_world; '
        'print(test_world.digest_of_a_run())'
    )
    digests = {
        subprocess.run(
            [sys.executable, '-c', code, str(Path(__file__).parent)],
            env=os.environ | {'PYTHONHASHSEED': seed, 'OMP_NUM_THREADS': threads},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for seed, threads in (('1', '1'), ('2', '4'))
    }
    assert digests == {f'{digest_of_a_run()}\n'}


def digest_of_a_run() -> str:
    """SHA-256 of every array and number of a short run with all sensors of the box scene."""
    from continuum_loc.simulator.scenes import load_scene

    digest = hashlib.sha256()
    arm = load_robot('soft_arm')
    for sample in World(arm, load_scene('R4'), 'b2', tof_fidelity='vl53l5cx', seed=5).run(0.3):
        for value in arrays(sample):
            digest.update(
                value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            )
    return digest.hexdigest()


def test_another_seed_changes_every_noisy_sample_and_no_truth(scene):
    robot = load_robot('engine')
    a, b = (list(World(robot, scene, 't1', seed=seed).run(0.3)) for seed in (3, 4))
    for x, y in zip(a, b, strict=True):
        assert same(x, y) == (type(x) is TruthSample)


def test_leaving_a_sensor_out_does_not_change_the_others():
    robot = load_robot('engine')
    full = list(World(robot, None, 't1').run(0.5))
    less = list(World(robot.model_copy(update={'strain': None}), None, 't1').run(0.5))
    kept = [sample for sample in full if type(sample) is not StrainSample]
    assert len(kept) == len(less) < len(full) and all(
        same(a, b) for a, b in zip(kept, less, strict=True)
    )


def test_tof_ranges_are_those_of_the_true_pose_at_their_own_stamps(scene):
    """Rays cast anew from the true ring poses meet the scene where the frame says, moving too."""
    from continuum_loc.simulator.raycast import RayCaster

    robot = load_robot('engine')
    silent = robot.tof_model.model_copy(update={'noise_coefficient': (1e-9,) * 3})
    robot = robot.model_copy(update={'tof_model': silent, 'strain': None, 'imu': ()})
    world, caster, errors = World(robot, scene, 't2'), RayCaster(scene), []
    for sample in world.run(2.4):
        if type(sample) is TofFrame and sample.stamp > 2.0 * NANOSECONDS:
            T_map_ring = world.full_state(robot.sensor_arclength(sample.sensor))
            T_map_sensor = T_map_ring @ robot.sensor(sample.sensor).mount.T_ring_sensor
            rays = silent.directions @ T_map_sensor[:3, :3].T
            distance = caster.cast(np.broadcast_to(T_map_sensor[:3, 3], rays.shape), rays)[0]
            hit = np.isfinite(sample.ranges)
            errors.append(sample.ranges[hit] - distance[hit])
    errors = np.concatenate(errors)
    assert len(errors) > 5000
    assert np.mean(np.abs(errors) < 1e-5) > 0.99  # the rest are returns from the robot's own body


def test_imu_noise_is_white_gaussian_of_the_stated_sigma():
    robot = load_robot('engine')
    model = ImuSensors(robot.imu_model, robot.imu, GRAVITY, np.random.default_rng(1))
    T, twist, acceleration = np.tile(np.eye(4), (5, 1, 1)), np.zeros((5, 6)), np.zeros((5, 3))
    samples = [s for k in range(400) for s in model.measure(k, T, twist, acceleration)]
    gyro = np.array([s.angular_velocity for s in samples]) / robot.imu_model.gyro_sigma
    accel = (
        np.array([s.linear_acceleration for s in samples]) - [0, 0, GRAVITY]
    ) / robot.imu_model.accel_sigma
    for residual in (gyro, accel):
        assert stats.kstest(residual.ravel(), 'norm').pvalue > FALSE_ALARM
        series = residual.reshape(400, -1)
        correlation = np.mean(series[1:] * series[:-1]) * np.sqrt(series[1:].size)
        assert abs(correlation) < stats.norm.isf(FALSE_ALARM / 2)


def test_imu_saturates_at_full_scale_and_biases_differ_by_sensor():
    robot = load_robot('hall_arm')
    model = ImuSensors(robot.imu_model, robot.imu, GRAVITY, np.random.default_rng(2))
    fast = np.zeros((3, 6))
    fast[:, 3] = 100.0
    sample = model.measure(0, np.tile(np.eye(4), (3, 1, 1)), fast, np.full((3, 3), 1e3))[0]
    assert sample.angular_velocity[0] == robot.imu_model.gyro_range
    np.testing.assert_array_equal(sample.linear_acceleration, robot.imu_model.accel_range)
    assert np.ptp(model.gyro_bias[:, 0]) > 0.0


def test_strain_noise_has_the_papers_sigmas_and_the_papers_meaning():
    robot = load_robot('engine')
    nodes_s = np.linspace(0.0, 1.5, 51)
    model = StrainSensor(robot.strain, robot.strain_stations, nodes_s, np.random.default_rng(3))
    theta, kappa = 0.7, 2.0
    strain = np.zeros((50, 6))
    strain[:, 3:] = kappa * np.array([0.0, -np.sin(theta), np.cos(theta)])
    samples = [model.measure(k, strain) for k in range(100)]
    angle = (np.array([s.theta for s in samples]) - theta) / robot.strain.theta_sigma
    bend = (np.array([s.kappa for s in samples]) - kappa) / robot.strain.kappa_sigma
    assert stats.kstest(angle.ravel(), 'norm').pvalue > FALSE_ALARM
    assert stats.kstest(bend.ravel(), 'norm').pvalue > FALSE_ALARM


def test_tracked_poses_are_as_uncertain_as_they_say():
    base = load_robot('engine')
    trackers = (Sensor(name='coil', ring='ring5'),)
    robot = base.model_copy(update={'tof': (), 'trackers': trackers})
    samples = list(World(robot, None, 't1', seed=5).run(1.0))
    truth = next(s for s in samples if type(s) is TruthSample).T_map_ring[5]
    poses = [s for s in samples if type(s) is TrackedPose]
    assert len(poses) == 50
    error = lie.log(lie.inverse(truth) @ np.array([s.T_map_sensor for s in poses]))
    squared = np.einsum('ki,ij,kj->', error, np.linalg.inv(poses[0].covariance), error)
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 300)
    assert low < squared < high


# --------------------------------------------------------------------------- the other robots


def test_the_hall_arm_reads_the_ring_magnet_and_the_earth():
    from continuum_loc.magnet import ring_field

    robot = quiet(load_robot('hall_arm'))
    world = World(robot, None, 'straight')
    samples = list(world.run(0.02))
    T_map_ring = next(s for s in samples if type(s) is TruthSample).T_map_ring
    earth = np.asarray(load_plant('hall_arm').earth_field)
    for k, sensor in enumerate(robot.hall):
        read = next(s for s in samples if type(s) is FieldSample and s.sensor == sensor.name).field
        R_map_base = T_map_ring[0, :3, :3]
        T_map_hall = T_map_ring[1 + k] @ sensor.mount.T_ring_sensor
        p = R_map_base.T @ (T_map_hall[:3, 3] - T_map_ring[0, :3, 3])
        expected = T_map_hall[:3, :3].T @ (R_map_base @ ring_field(robot.magnet, p) + earth)
        np.testing.assert_allclose(read, expected, atol=1e-10)


def test_hall_sensors_round_to_their_step_and_go_blind_beyond_full_scale():
    robot = load_robot('hall_arm')
    model = HallSensors(
        robot.hall_model,
        robot.hall[:1],
        None,
        np.array([1e-4, -2e-4, 1.0]),
        np.random.default_rng(0),
    )
    read = model.measure(0, np.eye(4)[None], np.eye(4))[0].field
    steps = read[:2] / np.asarray(robot.hall_model.lsb)[:2]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.isnan(read[2])


@pytest.mark.parametrize(('name', 'diameter'), [('groove160', 0.160), ('groove80', 0.080)])
def test_in_a_groove_the_hall_arm_lies_on_the_grooves_circle(name, diameter):
    world = World(load_robot('hall_arm'), None, name)
    for _ in world.run(6.0):
        pass
    s = np.linspace(0.0, 0.1, 41)
    points = world.full_state(s)[:, :3, 3]
    start = world.full_state(0.0)
    curve = (
        diameter
        / 2.0
        * np.stack([np.sin(2 * s / diameter), np.zeros(41), np.cos(2 * s / diameter) - 1.0], -1)
    )
    expected = start[:3, 3] + curve @ start[:3, :3].T
    assert np.linalg.norm(points - expected, axis=1).max() < 1e-3


def test_tendons_compress_the_soft_arm_by_a_tenth():
    world = World(load_robot('soft_arm'), None, 'b4')
    lengths = [
        np.linalg.norm(np.diff(world.full_state(world.nodes_s)[:, :3, 3], axis=0), axis=1).sum()
        for sample in world.run(7.0)
        if type(sample) is TruthSample
    ]
    assert 0.07 < 1.0 - min(lengths) / 0.53 < 0.3
    assert max(lengths) < 1.05 * 0.53


@pytest.mark.parametrize('robot', ['engine', 'soft_arm', 'hall_arm'])
def test_every_trajectory_rests_a_second_and_stays_within_its_drives(robot):
    description, plant = load_robot(robot), load_plant(robot)
    for name in trajectory_names(description):
        path = trajectory(name, description, plant)
        times = np.arange(0.0, path.duration + 0.5, 0.01)
        commands = [path.command(t) for t in times]
        tension = np.array([c.tension for c in commands])
        assert np.ptp(tension[:100], axis=0).max() == 0.0
        assert tension.min() >= 0.0 and np.all(tension < plant.max_forces), name
        insertion = np.array([c.insertion for c in commands])
        rate = np.array([c.insertion_rate for c in commands])
        assert insertion.min() >= 0.0 and insertion.max() <= description.base.insertion.range[1]
        np.testing.assert_allclose(np.diff(insertion), 0.005 * (rate[1:] + rate[:-1]), atol=1e-4)


def test_there_are_enough_trajectories_and_seeds_vary_them():
    assert trajectory_names(load_robot('engine')) == ('t1', 't2', 't3')
    assert len(trajectory_names(load_robot('soft_arm'))) >= 5
    robot, plant = load_robot('engine'), load_plant('engine')
    base, a, b, again = (trajectory('t1', robot, plant, seed) for seed in (0, 1, 2, 1))
    np.testing.assert_array_equal(a.tensions, again.tensions)
    assert not np.array_equal(a.tensions, b.tensions) and not np.array_equal(
        a.tensions, base.tensions
    )
    np.testing.assert_array_equal(a.tensions[0], base.tensions[0])


@pytest.mark.parametrize('robot', ['engine', 'soft_arm'])
def test_contacts_hold_the_body_out_of_the_scene(robot):
    """No node ever comes nearer to the mesh than the body's radius less a few millimetres."""
    from continuum_loc.simulator.scenes import load_scene
    import open3d as o3d

    description = load_robot(robot).model_copy(update={'tof': ()})
    scene = load_scene('S0' if robot == 'engine' else 'R4')
    mesh = o3d.t.geometry.RaycastingScene()
    mesh.add_triangles(
        o3d.core.Tensor(np.asarray(scene.vertices, np.float32)),
        o3d.core.Tensor(np.asarray(scene.faces, np.uint32)),
    )
    world = World(description, scene, 't3' if robot == 'engine' else 'b5')
    inside = []
    for sample in world.run(7.0):
        if type(sample) is TruthSample and sample.stamp % 100_000_000 == 0:
            points = world.full_state(world.nodes_s[world.nodes_s > 0.3 * description.length])[
                :, :3, 3
            ]
            inside.append(
                description.radius - mesh.compute_distance(points.astype(np.float32)).numpy().min()
            )
    assert len(inside) == 70
    assert max(inside) < 0.005
    if robot == 'engine':
        assert max(inside) > -0.002  # the trajectory does lean on the blades


@pytest.mark.parametrize(
    ('scene', 'path', 'until'), [('R1', 'b6', 8.5), ('R2', 'b7', 6.5), ('R3', 'b8', 8.1)]
)
def test_the_soft_arm_touches_what_stands_in_the_box(scene, path, until):
    from continuum_loc.simulator.scenes import load_scene

    arm = load_robot('soft_arm').model_copy(update={'tof': (), 'imu': ()})
    world = World(arm, load_scene(scene), path)
    depth = [world.body.penetration() for _ in world.run(until)]
    assert 0.0 < max(depth) < 0.01  # a tap at a metre a second, held by a rigid object
    empty = World(arm, load_scene('R0'), path)
    assert not any(empty.body.penetration() for _ in empty.run(until))


# --------------------------------------------------------------------------- bad input


def test_unknown_trajectories_name_the_valid_ones():
    with pytest.raises(
        SettingsError,
        match="no trajectory 't9'; give a .yaml file of your own, or one of t1, t2, t3",
    ):
        World(load_robot('engine'), None, 't9')


def test_a_trajectory_of_ones_own_is_read_from_yaml(tmp_path):
    path = tmp_path / 'lean.yaml'
    path.write_text(
        'keyframes:\n  - {time: 1.0, tensions: [1, 1, 1, 1]}\n'
        '  - {time: 3.0, tensions: [1, 9, 1, 1]}\n'
    )
    made = trajectory(str(path), load_robot('soft_arm'), load_plant('soft_arm'))
    assert made.name == 'lean' and made.duration == 3.0
    np.testing.assert_allclose(made.command(0.5).tension, 1.0)
    np.testing.assert_allclose(made.command(9.0).tension, [1, 9, 1, 1])
    with pytest.raises(
        SettingsError, match=r"lean.yaml: keyframes.0.tensions: 4 values for the plant's 9 tendons"
    ):
        trajectory(str(path), load_robot('engine'), load_plant('engine'))
    path.write_text('keyframes:\n  - {time: 0.2, tensions: [1]}\n  - {time: 3.0, tension: [1]}\n')
    with pytest.raises(
        SettingsError,
        match=r"(?s)keyframes.0.time.*unknown key 'keyframes.1.tension'; did you mean",
    ):
        trajectory(str(path), load_robot('soft_arm'), load_plant('soft_arm'))
    path.write_text(
        'keyframes:\n  - {time: 3.0, tensions: [1, 1, 1, 1]}\n'
        '  - {time: 2.0, tensions: [1, 1, 1, 1]}\n'
    )
    with pytest.raises(SettingsError, match='lean.yaml: .*increasing times'):
        trajectory(str(path), load_robot('soft_arm'), load_plant('soft_arm'))


def test_a_trajectory_for_other_drives_is_refused():
    times = np.array([1.0, 2.0])
    with pytest.raises(SettingsError, match='drives 4 tendons, the plant has 9'):
        World(load_robot('engine'), None, Drive('mine', times, np.ones((2, 4)), np.zeros(2)))
    with pytest.raises(SettingsError, match='can travel 0.0 to 0.6 m'):
        World(
            load_robot('engine'),
            None,
            Drive('mine', times, np.ones((2, 9)), np.array([0.0, 0.9])),
        )


@pytest.mark.parametrize(
    ('times', 'tensions', 'message'),
    [
        ([1.0, 1.0], [[1.0], [1.0]], 'increasing times'),
        ([1.0, 2.0], [[1.0], [-1.0]], 'tendons only pull'),
        ([1.0, 2.0], [[1.0], [np.nan]], 'finite keyframes'),
    ],
)
def test_impossible_keyframes_are_refused(times, tensions, message):
    with pytest.raises(ValueError, match=message):
        Drive('mine', np.array(times), np.array(tensions), np.zeros(2))


# --------------------------------------------------------------------------- faults


@pytest.fixture(scope='module')
def clean(scene):
    return list(World(load_robot('engine'), scene, 't1').run(1.0))


def test_dropout_loses_the_stated_share_of_the_chosen_sensors_only(clean):
    kept = list(faults.Dropout(sensors=('ring2_*',), probability=0.3, seed=1)(clean))
    chosen = [s for s in clean if faults.source(s).startswith('ring2_')]
    lost = len(clean) - len(kept)
    low, high = stats.binom.interval(1.0 - FALSE_ALARM, len(chosen), 0.3)
    assert low <= lost <= high
    assert [s for s in clean if s not in chosen] == [s for s in kept if s not in chosen]


def test_faults_begin_and_end_and_spare_the_truth(clean):
    kept = list(faults.Dropout(start=0.2, end=0.6)(clean))
    times = [seconds(s.stamp, clean[0].stamp) for s in kept if type(s) is not TruthSample]
    assert not any(0.2 <= t < 0.6 for t in times) and max(times) > 0.9
    assert sum(type(s) is TruthSample for s in kept) == 100


def test_frozen_sensors_repeat_their_last_good_values_under_new_stamps(clean):
    stuck = list(faults.Freeze(sensors=('ring3_tof1',), start=0.5)(clean))
    frames = [s for s in stuck if faults.source(s) == 'ring3_tof1']
    before = [f for f in frames if seconds(f.stamp, clean[0].stamp) < 0.5][-1]
    after = [f for f in frames if seconds(f.stamp, clean[0].stamp) >= 0.5]
    assert len(after) >= 6 and len({f.stamp for f in after}) == len(after)
    assert all(np.array_equal(f.ranges, before.ranges) for f in after)


def test_bias_steps_add_a_constant_from_their_start(clean):
    stepped = list(faults.BiasStep(sensors=('ring1_imu',), start=0.5, gyro=(0.1, 0.0, 0.0))(clean))
    differences = defaultdict(list)
    for a, b in zip(clean, stepped, strict=True):
        if type(a) is ImuSample:
            late = a.sensor == 'ring1_imu' and seconds(a.stamp, clean[0].stamp) >= 0.5
            differences[late].append(b.angular_velocity - a.angular_velocity)
    np.testing.assert_allclose(differences[True], np.tile([0.1, 0.0, 0.0], (50, 1)), atol=1e-12)
    assert np.all(np.array(differences[False]) == 0.0)


def test_outliers_replace_the_stated_share_of_zones_along_their_rays(clean):
    wild = list(faults.Outliers(probability=0.1, seed=2)(clean))
    pairs = [(a, b) for a, b in zip(clean, wild, strict=True) if type(a) is TofFrame]
    valid = np.concatenate([np.isfinite(a.ranges) for a, _ in pairs])
    changed = np.concatenate([a.ranges != b.ranges for a, b in pairs])
    assert not np.any(changed & ~valid)
    low, high = stats.binom.interval(1.0 - FALSE_ALARM, valid.sum(), 0.1)
    assert low <= changed.sum() <= high
    for _, b in pairs[:20]:
        ok = np.isfinite(b.ranges)
        np.testing.assert_allclose(np.linalg.norm(b.points[ok], axis=1), b.ranges[ok], rtol=1e-9)


def test_delayed_samples_arrive_late_with_their_own_stamps(clean):
    late = list(faults.Delay(sensors=('strain',), delay=0.1)(clean))
    assert len(late) == len(clean) and {id(s) for s in late} == {id(s) for s in clean}
    place = {id(s): k for k, s in enumerate(late)}
    for sample in clean:
        if type(sample) is StrainSample and seconds(sample.stamp, clean[0].stamp) < 0.85:
            newest = max(s.stamp for s in late[: place[id(sample)]])
            assert 0.09 <= seconds(newest, sample.stamp) <= 0.11


def test_a_wrong_clock_shifts_stamps_and_nothing_else(clean):
    shifted = list(faults.ClockOffset(sensors=('ring1_tof*',), offset=0.02, drift=0.01)(clean))
    for a, b in zip(clean, shifted, strict=True):
        if faults.source(a).startswith('ring1_tof'):
            since = seconds(a.stamp, clean[0].stamp)
            assert seconds(b.stamp, a.stamp) == pytest.approx(0.02 + 0.01 * since, abs=1e-6)
            assert a.ranges is b.ranges
        else:
            assert a is b


def test_miscalibration_moves_every_mount_by_about_the_stated_amount():
    robot = load_robot('engine')
    wrong = faults.miscalibrated(robot, 0.002, 1.0, seed=1)
    error = np.array(
        [
            lie.log(lie.inverse(a.mount.T_ring_sensor) @ b.mount.T_ring_sensor)
            for a, b in zip(robot.tof, wrong.tof, strict=True)
        ]
    )
    z = error / np.repeat([0.002, np.radians(1.0)], 3)
    assert stats.kstest(z.ravel(), 'norm').pvalue > FALSE_ALARM
    same_mounts = faults.miscalibrated(robot, 0.002, 1.0, seed=1, sensors=('ring1_*',))
    assert (
        same_mounts.tof[5].mount == robot.tof[5].mount
        and same_mounts.tof[0].mount == wrong.tof[0].mount
    )


def test_world_applies_its_faults_in_order(scene):
    fault = faults.Dropout(sensors=('*_tof*',))
    samples = list(World(load_robot('engine'), scene, 't1', faults=(fault,)).run(0.2))
    assert not any(type(s) is TofFrame for s in samples) and any(
        type(s) is ImuSample for s in samples
    )


def test_a_fault_that_ends_before_it_starts_is_refused():
    with pytest.raises(ValueError, match='must come before'):
        faults.Dropout(start=2.0, end=1.0)


def test_the_robot_of_the_documentation_is_simulated(tmp_path):
    """A newcomer's first files are those of docs/simulator.md."""
    text = (Path(__file__).parents[1] / 'docs' / 'simulator.md').read_text()
    files = dict(re.findall(r'`(my_\w+\.yaml)`[^`]*```yaml\n(.*?)```', text, re.DOTALL))
    assert set(files) == {'my_robot.yaml', 'my_plant.yaml', 'my_path.yaml'}
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    world = World(
        load_robot(tmp_path / 'my_robot.yaml'),
        None,
        str(tmp_path / 'my_path.yaml'),
        plant=tmp_path / 'my_plant.yaml',
        profile='full',
    )
    truth = [s.T_map_ring for s in world.run(4.0) if type(s) is TruthSample]
    assert np.linalg.norm(truth[-1][-1, :3, 3] - truth[0][-1, :3, 3]) > 0.1


def test_real_tof_sensors_run_out_of_step_each_at_its_own_rate():
    """Those of the paper share their instants; real ones start anywhere in a period of 1/15 s."""
    from continuum_loc.simulator.scenes import load_scene

    arm = load_robot('soft_arm')
    world = World(arm, load_scene('R1'), 'b2', tof_fidelity='vl53l5cx', seed=3)
    stamps = {sensor.name: [] for sensor in arm.tof}
    for sample in world.run(2.0):
        if isinstance(sample, TofFrame):
            stamps[sample.sensor].append(sample.stamp)
    first = np.array([times[0] for times in stamps.values()])
    assert len(set(first)) == len(first) and np.ptp(first) > 0.02e9
    for times in stamps.values():
        steps = np.diff(times)
        # One period, none (read out together), or two where a frame was waited for or lost.
        assert np.all(steps >= 0) and np.median(steps) == pytest.approx(1e9 / 15.0, rel=0.02)
        assert 27 <= len(times) <= 30
