"""Constants of the robot: corrections, their border of the chain, and finding them online."""

from dataclasses import replace

from continuum_loc import lie
from continuum_loc.calibration.batch import calibrate
from continuum_loc.corrections import Corrections
from continuum_loc.errors import CalibrationError
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.border import Border
from continuum_loc.estimator.chain import Chain
from continuum_loc.estimator.factors import FACTORS, Setup
from continuum_loc.estimator.normal import Normal, symmetric
from continuum_loc.estimator.parameters import Parameters, PARTS
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.state import column_at_rest, Grid
from continuum_loc.measurements import (
    ImuSample,
    nanoseconds,
    StrainSample,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from continuum_loc.offline.calibrated import told
from continuum_loc.offline.metrics import errors
from continuum_loc.robot import mounted, RobotDescription, Tolerances
from continuum_loc.settings import parse_settings
from continuum_loc.trajectory import Trajectory
import numpy as np
import pytest
from worlds import EPOCH, EXACT, Rod, rod, room_map, stream

DT = 0.1
BUILT = Tolerances()
FLAT = parse_settings(EstimatorSettings, {'tof': {'floor': 1.0, 'gate': 1.0}})


def described(tolerances: dict | None = None, **changes) -> RobotDescription:
    """Describe the rod of the small world with tolerances."""
    data = rod().model_dump() | changes
    data['tolerances'] = Tolerances().model_dump() if tolerances is None else EXACT | tolerances
    return parse_settings(RobotDescription, data)


# ------------------------------------------------------------------- corrections of measurements


def test_a_range_is_read_as_the_sensor_would_have_it_without_offset_and_scale():
    """A unit that reads 1.02 d + 8 mm gives 0.416 m at 0.4 m."""
    data = rod().model_dump(mode='json')
    data['tof'][0] |= {'range_offset': 0.008, 'range_scale': 1.02}
    robot = parse_settings(RobotDescription, data)
    rays = robot.tof_model.directions
    frame = TofFrame(
        EPOCH, 'r1_tof0', 0.416 * rays, np.full(64, 0.416), np.full(64, 0.01), np.full(64, 5)
    )
    corrected = Corrections(robot).applied(frame)
    np.testing.assert_allclose(corrected.ranges, 0.4, atol=1e-12)
    np.testing.assert_allclose(corrected.points, 0.4 * rays, atol=1e-12)


def test_a_gyro_is_read_along_the_axes_that_it_has():
    """Axes 2 % too long and a bias: 1 rad/s about z reads 1.02, and 0.01 more."""
    data = rod().model_dump(mode='json')
    axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.02]]
    data['imu'][0] |= {'gyro_axes': axes, 'gyro_bias': [0.0, 0.0, 0.01], 'clock': -0.03}
    robot = parse_settings(RobotDescription, data)
    sample = ImuSample(EPOCH, 'r1_imu', np.array([0.0, 0.0, 1.03]), np.zeros(3))
    corrected = Corrections(robot).applied(sample)
    np.testing.assert_allclose(corrected.angular_velocity, [0.0, 0.0, 1.0], atol=1e-12)
    assert corrected.stamp == EPOCH - nanoseconds(0.03)


def test_a_twisted_strain_sensor_is_read_in_the_planes_of_the_body():
    """Bending by 2 1/m about z is theta 0; a sensor twisted by 90 deg has it at theta 90 deg."""
    data = rod().model_dump(mode='json')
    data['strain'] |= {'twist_deg': 90.0, 'scale': 1.5}
    robot = parse_settings(RobotDescription, data)
    s = np.array([0.1])
    read = StrainSample(EPOCH, s, np.array([np.pi / 2.0]), np.array([3.0]))
    corrected = Corrections(robot).applied(read)
    np.testing.assert_allclose(corrected.theta, 0.0, atol=1e-12)
    np.testing.assert_allclose(corrected.kappa, 2.0, atol=1e-12)


def test_an_exact_robot_has_no_constants_and_is_not_touched():
    robot = rod()
    assert Parameters(robot).size == 0
    sample = ImuSample(EPOCH, 'r1_imu', np.ones(3), np.zeros(3))
    assert Corrections(robot).applied(sample) is sample


def test_counting_constants_from_elsewhere_is_the_sum():
    """Twice by half of each offset is once by the whole, in everything that is not a rotation."""
    parameters = Parameters(described())
    theta = np.zeros(parameters.size)
    for kind, name in (('range', 'r1_tof0'), ('strain', 'strain'), ('clock', 'board r1')):
        theta[parameters.columns(kind, [name])[0]] = 0.002
    once = parameters.applied(theta)
    twice = parameters.at(0.5 * theta).applied(0.5 * theta)
    assert twice.tof[0].range_offset == pytest.approx(once.tof[0].range_offset, rel=2e-3)
    assert twice.tof[0].range_scale == pytest.approx(once.tof[0].range_scale, rel=1e-5)
    assert twice.strain.twist_deg == pytest.approx(once.strain.twist_deg)
    assert twice.imu[0].clock == pytest.approx(0.002)


# -------------------------------------------------------------------------------- the border


def samples_of(kind: type, robot: RobotDescription):
    if kind is TrackedPose:
        near = columns(Grid(robot, 0.16))[0].T[-1] @ mount_of(robot)
        pose = near @ lie.exp(np.array([0.002, 0.001, -0.003, 0.01, 0.02, -0.01]))
        return [TrackedPose(EPOCH, 'coil', pose, 1e-4 * np.eye(6))]
    found = [one for one in stream(Rod(robot), 0.1) if isinstance(one, kind)]
    return found[:7]


@pytest.mark.parametrize('kind', [TofFrame, ImuSample, StrainSample, TrackedPose])
def test_the_border_is_the_derivative_of_the_cost(kind):
    """
    Describe the robot a little otherwise, and the cost changes by the gradient.

    Weights are held while linearising: noise across the surface hides that of ranges, which hangs
    on the incidence.
    """
    mount = {'xyz': [0.01, 0.0, 0.005], 'rpy_deg': [10.0, 20.0, 5.0]}
    robot = described(trackers=[{'name': 'coil', 'ring': 'r2', 'mount': mount}])
    parameters = Parameters(robot)
    grid = Grid(robot, 0.16)
    a, b = columns(grid)
    samples = samples_of(kind, robot)

    def cost(theta: np.ndarray, border: Border | None = None) -> float:
        changed = parameters.applied(theta)
        setup = Setup(changed, grid, FLAT, room_map(0.05))
        factor = next(one for one in FACTORS if one.consumes is kind)(setup)
        corrections, total = Corrections(changed), 0.0
        batch = factor.stack(
            np.array([0.02 + 0.01 * k for k in range(len(samples))])
            + [by @ theta for by in map(parameters.lateness, map(board, samples))],
            [factor.row(corrections.applied(one)) for one in samples],
        )
        total += factor.linearise(batch, a, b, Normal.zeros(2 * grid.dim)).cost
        if border is not None:
            factor.bordered(batch, a, b, border, parameters)
        return total

    border = Border.zeros(2 * grid.dim, parameters.size)
    cost(np.zeros(parameters.size), border)
    np.testing.assert_allclose(border.H, border.H.T, atol=1e-9 * np.abs(border.H).max())
    assert np.count_nonzero(border.g) >= 4
    for block in parameters.blocks:
        for i, part in enumerate(PARTS[block.kind]):
            step = np.zeros(parameters.size)
            step[block.at.start + i] = 1e-3 * block.sigma[i]
            slope = (cost(step) - cost(-step)) / (2e-3 * block.sigma[i])
            expected = border.g[block.at.start + i]
            scale = 1e-3 * np.abs(border.g[block.at]).max() + 1e-6
            assert slope == pytest.approx(expected, rel=1e-2, abs=scale), (block.name, part)


def mount_of(robot: RobotDescription) -> np.ndarray:
    return robot.trackers[0].mount.T_ring_sensor


def board(sample) -> str:
    return getattr(sample, 'sensor', 'strain')


def columns(grid: Grid):
    rng = np.random.default_rng(0)
    strain = np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1))
    strain[:, 3:] += 0.2 * rng.normal(size=(grid.nodes, 3))
    a = column_at_rest(grid, lie.exp(0.02 * rng.normal(size=6)), strain, 0.0)
    a = a.retract(0.01 * rng.normal(size=grid.dim))
    return a, a.predict(DT).retract(0.01 * rng.normal(size=grid.dim))


def test_the_border_of_the_base_is_the_derivative_of_its_prior():
    robot = described()
    parameters, grid = Parameters(robot), Grid(robot, 0.16)
    _, column = columns(grid)
    border = Border.zeros(grid.dim, parameters.size)
    Priors(robot, grid, EstimatorSettings()).bordered(border, column, 1.0, parameters)
    at = parameters.columns('base', [''])[0]
    sigma = np.repeat([robot.base.sigma_position, np.radians(robot.base.sigma_rotation_deg)], 3)
    weight = None

    def error(theta):
        T_map_base = parameters.applied(theta).base.T_map_base
        return lie.log(lie.inverse(T_map_base) @ column.T[0]) / sigma

    for i in at:
        step = np.zeros(parameters.size)
        step[i] = 1e-7
        slope = (error(step) @ error(step) - error(-step) @ error(-step)) / 4e-7
        if weight is None:
            weight = border.g[i] / slope  # a base so far off is let go in part, all of it alike
        assert border.g[i] == pytest.approx(weight * slope, rel=1e-4)
    assert 0.0 < weight <= 1.0 + 1e-6


def test_carrying_the_border_on_is_the_elimination_of_all_columns_at_once():
    """Three columns of five and two constants, by hand and by a dense Schur complement."""
    D, K, P, rng = 5, 3, 2, np.random.default_rng(3)
    size = K * D + P
    whole, g = np.zeros((size, size)), np.zeros(size)

    def add(rows):
        A, e = rng.normal(size=(12, len(rows))), rng.normal(size=12)
        whole[np.ix_(rows, rows)] += A.T @ A
        g[rows] += A.T @ e
        return A.T @ A, A.T @ e

    first, gradient = add(np.arange(D))
    chain = Chain(D, Normal(np.triu(first), gradient))
    past = Border.zeros(D, P)
    constants = np.arange(K * D, size)
    parts = []
    for k in range(K - 1):
        H, e = add(np.concatenate([D * k + np.arange(2 * D), constants]))
        x, theta = slice(2 * D), slice(2 * D, 2 * D + P)
        parts.append(
            (
                Normal(np.triu(H[x, x]), e[x]),
                Border(H[x, theta], H[theta, theta], e[theta]),
            )
        )
    for normal, border in parts:
        chain.make_oldest_ready(normal, True)
        C, Z = chain.pass_on(past.C + border.C[:D], border.C[D:])
        y = chain.oldest
        past = Border(C, past.H + border.H - Z.T @ Z, past.g + border.g - y @ Z)
        chain.forget_oldest()
    newest = chain.marginals[0]
    W = np.linalg.solve(symmetric(newest.H), past.C)
    covariance = np.linalg.inv(past.H - past.C.T @ W)
    mean = -covariance @ (past.g - newest.g @ W)
    np.testing.assert_allclose(covariance, np.linalg.inv(whole)[-P:, -P:], rtol=1e-8)
    np.testing.assert_allclose(mean, -np.linalg.solve(whole, g)[-P:], rtol=1e-8)


# ---------------------------------------------------------------------------- found online


def truly(robot: RobotDescription, seed: int) -> RobotDescription:
    """Mount every ToF sensor 2 mm and 1 deg off per axis."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat([BUILT.mount_position, np.radians(BUILT.mount_rotation_deg)], 3)
    moved = [
        one.model_copy(
            update={
                'mount': mounted(one.mount.T_ring_sensor @ lie.exp(sigma * rng.normal(size=6)))
            }
        )
        for one in robot.tof
    ]
    return robot.model_copy(update={'tof': tuple(moved)})


def localised(robot, true_robot, duration, seed, late=(), settings=None):
    """Localise a robot that is truly another; its filter, errors and whom it named."""
    data = {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2} | (settings or {})
    filter_ = SlidingWindowFilter(robot, room_map(), parse_settings(EstimatorSettings, data))
    stamps, poses, covariances, truth, named = [], [], [], [], {}
    for sample in stream(Rod(true_robot, seed=seed), duration, seed):
        if isinstance(sample, TruthSample):
            truth.append(sample)
            continue
        if getattr(sample, 'sensor', '') in late:
            sample = replace(sample, stamp=sample.stamp + nanoseconds(0.06))
        estimate = filter_.process(sample)
        if estimate is not None:
            stamps.append(estimate.stamp)
            poses.append(estimate.T_map_ring)
            covariances.append(estimate.covariance)
            named |= estimate.suspects
    names = ('base', *robot.ring_names)
    track = Trajectory(np.array(stamps), names, np.array(poses), np.array(covariances))
    known = Trajectory(
        np.array([one.stamp for one in truth]), names, np.array([one.T_map_ring for one in truth])
    )
    return filter_, errors(track, known), named


def test_mounts_that_are_off_are_found_and_what_is_left_is_told():
    """Three draws: half the error or less, an honest covariance, and nobody named."""
    nees, before, after = [], [], []
    for seed in (1, 2, 3):
        robot = described({'mount_position': 0.002, 'mount_rotation_deg': 1.0})
        true_robot = truly(robot, seed)
        _, found, named = localised(robot, true_robot, 6.0, seed)
        off = {'calibration': {'enabled': False}, 'health': {'clock_period': 0.0}}
        _, taken, _ = localised(robot, true_robot, 6.0, seed, settings=off)
        settled = slice(len(found) // 2, None)
        after.append(found.translation_m[settled, 1:].mean())
        before.append(taken.translation_m[settled, 1:].mean())
        nees.append(np.nanmean(found.nees[settled, 1:]) / 6.0)
        assert not named
    assert np.mean(after) <= 0.5 * np.mean(before)
    assert 0.3 <= np.mean(nees) <= 1.5


def test_a_late_board_is_named_and_nobody_else():
    """
    ToF and IMU of the tip come 60 ms late, against the middle board and the strain sensor.

    Half of that is found within 6 s, online: as linear equations have it, the motion's prior
    resists a shift of the motion.
    """
    robot = described({'clock': 0.03})
    late = {one.name for one in (*robot.tof, *robot.imu) if one.ring == 'r2'}
    filter_, _, named = localised(robot, robot, 6.0, 4, late=late)
    assert set(named) == late
    assert all(reason.endswith('ms late') for reason in named.values())
    assert -0.065 < filter_.setup.robot.tof[-1].clock < -0.03


# ------------------------------------------------------------------- found from a recording


def test_a_recording_with_truth_tells_mounts_and_ranges():
    """
    Mounts 2 mm and 1 deg off are found to 0.5 mm along the beams and 0.2 deg, and as well as told.

    Root mean squares over sensors. Along the body they stay unknown: walls are smooth there.
    """
    robot = described({'mount_position': 0.002, 'mount_rotation_deg': 1.0})
    true_robot = truly(robot, 5)
    settings = parse_settings(EstimatorSettings, {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2})
    recording = list(stream(Rod(true_robot, seed=5), 4.0, 5))
    found = calibrate(robot, room_map(), [recording], settings, 'truth')
    off = np.array(
        [
            lie.log(lie.inverse(one.mount.T_ring_sensor) @ other.mount.T_ring_sensor)
            for one, other in zip(found.robot.tof, true_robot.tof, strict=True)
        ]
    )
    assert found.converged
    assert np.sqrt(np.mean(off[:, 0] ** 2)) < 5e-4
    assert np.degrees(np.sqrt(np.mean(off[:, 3:] ** 2))) < 0.2
    stated = np.array([found.sigma[one.at] for one in found.parameters.blocks])
    assert 0.5 < np.sqrt(np.mean(np.square(off / stated))) < 1.6
    assert found.robot.trackers == robot.trackers
    assert '| r1_tof0 mount x | 0 +- 2.00 mm |' in told(found)


@pytest.mark.parametrize(
    ('reference', 'said'), [('moon', 'valid are'), ('tracker', 'has no tracker')]
)
def test_a_reference_that_is_not_there_is_refused(reference, said):
    with pytest.raises(CalibrationError, match=said):
        calibrate(described(), None, [[]], EstimatorSettings(), reference)


def test_an_exact_robot_cannot_be_calibrated():
    with pytest.raises(CalibrationError, match='exactly as described'):
        calibrate(rod(), None, [[]], EstimatorSettings())
