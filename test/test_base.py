"""A base that is carried: what its measurement weighs, and what a body that moves as one costs."""

from heapq import merge

from continuum_loc import lie
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.factors import FACTORS, Setup
from continuum_loc.estimator.normal import Normal, symmetric
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.state import column_at_rest, Grid
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    nanoseconds,
    TruthSample,
)
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
import numpy as np
import pytest
import worlds
from worlds import EPOCH, Rod, rod, room_map, stream

DT = 0.1
SPREAD = np.array([0.0005] * 3 + [np.radians(0.1)] * 3)  # of a base, as descriptions have it
LOOSE = parse_settings(EstimatorSettings, {'base': {'cauchy': 1e6}})


def carried(mode: str = 'measured', insertion: dict | None = None, **base) -> RobotDescription:
    """Describe the rod of the small world on a base that is carried."""
    data = rod().model_dump()
    data['base'] |= {'mode': mode, **base}
    data['base']['insertion'] = insertion or {'mode': 'fixed'}
    return parse_settings(RobotDescription, data)


def base_factor(robot: RobotDescription, settings: EstimatorSettings = LOOSE):
    setup = Setup(robot, Grid(robot, 0.16), settings)
    return next(kind for kind in FACTORS if kind.name == 'base')(setup)


def columns(grid: Grid, seed: int):
    rng = np.random.default_rng(seed)
    strain = np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1))
    frame = lie.exp(0.3 * rng.normal(size=(1, 6)))
    T_map_base = lie.exp(0.5 * rng.normal(size=6))
    a = column_at_rest(grid, T_map_base, strain, 0.0, None, frame)
    a = a.retract(0.02 * rng.normal(size=grid.dim))
    return a, a.predict(DT).retract(0.02 * rng.normal(size=grid.dim))


def ends_of(function, a, b, x):
    """Values of `function(a, b)` a step of 1e-6 forth and back along x (2 D,)."""
    x_a, x_b = np.split(1e-6 * x, 2)
    return [function(a.retract(sign * x_a), b.retract(sign * x_b)) for sign in (1.0, -1.0)]


@pytest.mark.parametrize('seed', range(3))
def test_gradient_is_the_derivative_of_the_squared_error(seed):
    robot = carried(insertion={'mode': 'measured', 'range': [0.0, 0.5], 'sigma': 0.001})
    factor, grid = base_factor(robot), Grid(robot, 0.16)
    a, b = columns(grid, seed)
    rng = np.random.default_rng(seed)
    near = lie.inverse(a.T_map_frame[0]) @ a.T[0]
    samples = [
        EncoderSample(EPOCH, ('insertion',), np.array([0.2]), np.zeros(1)),
        *(
            BaseSample(EPOCH + k, 'map', near @ lie.exp(0.1 * rng.normal(size=6)))
            for k in range(4)
        ),
    ]
    batch = factor.stack(np.linspace(0.0, 0.9, 5) * DT, [factor.row(one) for one in samples])
    normal = Normal.zeros(2 * grid.dim)
    factor.linearise(batch, a, b, normal)
    assert not np.tril(normal.H, -1).any()

    def squared(a, b):
        return factor.linearise(batch, a, b, Normal.zeros(2 * grid.dim)).squared

    for _ in range(6):
        # The frame hardly moves in an interval: its own step is taken for small.
        x = rng.normal(size=2 * grid.dim)
        x[-6:] = x[: grid.dim][-6:]
        forth, back = ends_of(squared, a, b._replace(T_map_frame=a.T_map_frame), x)
        normal = Normal.zeros(2 * grid.dim)
        factor.linearise(batch, a, b._replace(T_map_frame=a.T_map_frame), normal)
        assert (forth - back) / 4e-6 == pytest.approx(normal.g @ x, rel=1e-5, abs=1e-2)


@pytest.mark.parametrize(
    'told', [{'drift': 0.05, 'frame': 'odom'}, {'frame': 'map'}, {'frame': 'arm_base'}]
)
def test_gradient_of_the_prior_of_the_frame(told):
    robot = carried(measurement=told, sigma_position=0.01, sigma_rotation_deg=1.0)
    grid = Grid(robot, 0.16)
    priors = Priors(robot, grid, EstimatorSettings())
    rng = np.random.default_rng(0)
    a, b = columns(grid, 1)
    normal = Normal.zeros(2 * grid.dim)
    priors.add(normal, a, b)
    # Where the base sees the frame from is frozen: exact by the older frame, nearly by the newer.
    for at, tolerance in ((grid.dim, 1e-5), (2 * grid.dim, 0.05)):
        x = np.zeros(2 * grid.dim)
        x[:at][-6:] = rng.normal(size=6)
        forth, back = ends_of(
            lambda a, b: priors.add(Normal.zeros(2 * grid.dim), a, b)[0], a, b, x
        )
        assert (forth - back) / 2e-6 == pytest.approx(normal.g @ x, rel=tolerance)


def test_a_poses_weight_is_that_of_its_noise_where_the_node_is():
    """
    A base told to 1 mm and 1 deg, inserted by 0.5 m to 2 mm, by hand.

    Sideways a node sees the base's own 1 mm and a turn of 0.01745 rad at 0.5 m, 8.727 mm; along,
    1 mm and the encoder's 2 mm.
    """
    robot = carried(insertion={'mode': 'measured', 'range': [0.0, 0.6], 'sigma': 0.002})
    factor = base_factor(robot)
    covariance = np.diag([1e-6] * 3 + [np.radians(1.0) ** 2] * 3)
    rows = [
        factor.row(EncoderSample(EPOCH, ('insertion',), np.array([0.5]), np.zeros(1))),
        factor.row(BaseSample(EPOCH, 'map', np.eye(4), covariance)),
    ]
    batch = factor.stack(np.array([0.0, 0.0]), rows)
    found = np.linalg.inv(batch.roots[0].T @ batch.roots[0])
    assert found[0, 0] == pytest.approx(1e-6 + 4e-6)
    assert found[1, 1] == found[2, 2] == pytest.approx(1e-6 + 0.008727**2, rel=1e-3)
    np.testing.assert_allclose(batch.T_frame_node[0, :3, 3], [0.5, 0.0, 0.0], atol=1e-12)


def test_a_pose_between_two_encoder_samples_gets_the_travel_between_them_whoever_came_first():
    robot = carried(insertion={'mode': 'measured', 'range': [0.0, 0.6], 'sigma': 0.002})
    factor = base_factor(robot)
    pose = factor.row(BaseSample(EPOCH + nanoseconds(0.015), 'map', np.eye(4)))
    travels = [
        factor.row(
            EncoderSample(EPOCH + nanoseconds(t), ('insertion',), np.array([x]), np.zeros(1))
        )
        for t, x in ((0.01, 0.1), (0.02, 0.2))
    ]
    batch = factor.stack(np.array([0.015, 0.01, 0.02]), [pose, *travels])
    assert batch.T_frame_node[0, 0, 3] == pytest.approx(0.15)


def test_nothing_is_known_along_a_base_of_unknown_travel():
    robot = carried(insertion={'mode': 'unknown', 'range': [0.0, 0.6]})
    factor = base_factor(robot)
    batch = factor.stack(np.zeros(1), [factor.row(BaseSample(EPOCH, 'map', np.eye(4)))])
    information = batch.roots[0].T @ batch.roots[0]
    assert information[0, 0] < 1e-3 < 1e3 < information[1, 1]


def test_a_carried_base_that_speeds_up_costs_what_its_acceleration_says():
    """A change of velocity of the first node alone costs 4 / (q d) of its square."""
    grids = {}
    for mode in ('fixed', 'free'):
        robot = carried(mode, acceleration=[0.08, 0.2])
        grid = Grid(robot, 0.16)
        priors = Priors(robot, grid, EstimatorSettings())
        grids[mode] = priors.velocity_psd
    added = grids['free'] - grids['fixed']
    s = Grid(carried(), 0.16).s
    np.testing.assert_allclose(added[:, 0], 0.08)
    np.testing.assert_allclose(added[:, 2], 0.08 + 0.2 * s**2)
    np.testing.assert_allclose(added[:, 5], 0.2)


# ------------------------------------------------------------------------------------- the filter


class CarriedRod(Rod):
    """The bending rod on a base that moves by 6 cm and 12 deg, to and fro, after half a second."""

    def base(self, time: float) -> np.ndarray:
        moving = max(time - 0.5, 0.0)
        swing = moving**2 / (1.0 + moving**2) * np.sin(1.5 * moving)
        return lie.exp(swing * np.array([0.02, 0.06, 0.03, 0.1, 0.05, 0.2]))

    def poses(self, time: float, s: np.ndarray) -> np.ndarray:
        return self.base(time) @ super().poses(time, s)


def carried_stream(world: CarriedRod, duration: float, error=lambda time: np.eye(4), seed=0):
    """Yield samples of the rod and, before those of the same instant, poses of its base."""
    rng, frame = np.random.default_rng(seed), world.robot.base.measurement.frame
    told = world.robot.base.measurement
    sigma = np.array([told.sigma_position] * 3 + [np.radians(told.sigma_rotation_deg)] * 3)
    last = -1
    for sample in stream(world, duration, seed):
        if isinstance(sample, TruthSample) and sample.stamp != last:
            last = sample.stamp
            time = (sample.stamp - EPOCH) / 1e9
            T = error(time) @ world.base(time) @ lie.exp(sigma * rng.normal(size=6))
            yield BaseSample(sample.stamp, frame, T, np.diag(np.square(sigma)))
        yield sample


def run(robot, samples, prior_map):
    """Estimates, and the largest error of a ring [m] and the NEES of their poses, after 1 s."""
    filter_ = SlidingWindowFilter(robot, prior_map)
    truth, estimates = {}, []
    for sample in samples:
        if isinstance(sample, TruthSample):
            truth[sample.stamp] = sample.T_map_ring
        elif estimate := filter_.process(sample):
            estimates.append(estimate)
    late = [one for one in estimates if one.stamp > EPOCH + nanoseconds(1.0)]
    errors = np.array([lie.log(lie.inverse(one.T_map_ring) @ truth[one.stamp]) for one in late])
    nees = np.mean(
        [
            e @ np.linalg.solve(P, e)
            for one, es in zip(late, errors, strict=True)
            for e, P in zip(es, one.covariance, strict=True)
        ]
    )
    return filter_, late, np.linalg.norm(errors[..., :3], axis=-1), nees / 6.0


@pytest.fixture(scope='module')
def prior_map():
    return room_map(0.05)


@pytest.mark.parametrize('mode', ['measured', 'free'])
def test_a_rod_on_a_carried_base_is_followed(mode, prior_map):
    robot = carried(mode, sigma_position=0.001, sigma_rotation_deg=0.1)
    samples = carried_stream(CarriedRod(carried()), 4.0)
    kept = (one for one in samples if mode == 'measured' or not isinstance(one, BaseSample))
    _, estimates, errors, nees = run(robot, kept, prior_map)
    assert errors.mean() < 0.0015 and errors.max() < 0.006
    assert 0.3 < nees < 2.0
    assert {one.status for one in estimates} == {'tracking'}


def test_a_frame_that_drifts_is_found(prior_map):
    """Odometry that is off by 2 mm per second and 3 cm, 2 deg from the start."""
    told = {'frame': 'odom', 'drift': 0.1, 'sigma_position': 2e-4, 'sigma_rotation_deg': 0.02}
    robot = carried(measurement=told, sigma_position=0.002, sigma_rotation_deg=0.2)
    start = lie.exp(np.array([0.03, 0.0, 0.01, 0.0, 0.035, 0.0]))

    def error(time):
        return lie.exp(np.array([0.0, 0.002 * time, 0.0, 0.0, 0.0, 0.0])) @ start

    _, estimates, errors, nees = run(
        robot, carried_stream(CarriedRod(robot), 5.0, error), prior_map
    )
    assert errors.mean() < 0.0015 and 0.3 < nees < 2.0
    last = estimates[-1]
    # What the true odometry says the base is, put where the estimate has that frame.
    T_map_base = last.T_map_ring[0]
    told = last.T_map_frame @ error((last.stamp - EPOCH) / 1e9) @ T_map_base
    off = lie.log(lie.inverse(T_map_base) @ told)
    assert np.linalg.norm(off[:3]) < 0.003 and np.degrees(np.linalg.norm(off[3:])) < 0.3
    seen = lie.adjoint(lie.inverse(T_map_base) @ last.T_map_frame)
    spread = seen @ last.frame_covariance @ seen.T
    assert off @ np.linalg.solve(spread, off) < 27.9  # chi-squared of six at 1e-4


def test_a_base_said_to_be_fixed_that_moves_is_told_and_let_go(prior_map):
    robot = carried('fixed')
    kept = (
        one for one in carried_stream(CarriedRod(robot), 4.0) if not isinstance(one, BaseSample)
    )
    _, estimates, errors, _ = run(robot, kept, prior_map)
    off = [
        np.linalg.norm(lie.log(CarriedRod(robot).base((one.stamp - EPOCH) / 1e9)) / SPREAD)
        for one in estimates
    ]
    moved = next(one.stamp for one, far in zip(estimates, off, strict=True) if far > 10.0)
    told = next(one.stamp for one in estimates if one.doubts and one.doubts[0][:4] == 'base')
    assert told - moved < nanoseconds(0.5)
    after = [k for k, one in enumerate(estimates) if one.stamp > told + nanoseconds(0.5)]
    assert errors[after][:, 1:].mean() < 0.003
    assert {estimates[k].status for k in after} == {'doubtful'}


def test_an_encoder_off_by_3_cm_is_named_and_the_base_is_not(prior_map):
    insertion = {'mode': 'measured', 'range': [-0.2, 0.2], 'sigma': 0.0005}
    robot = carried('fixed', insertion=insertion)
    samples = stream(Rod(robot), 2.0)
    encoder = (
        EncoderSample(EPOCH + nanoseconds(0.02 * k), ('insertion',), np.array([x]), np.zeros(1))
        for k, x in enumerate([0.0] * 50 + [0.03] * 50)
    )
    _, estimates, errors, _ = run(robot, merge(samples, encoder, key=stamp_of), prior_map)
    named = {name for one in estimates for name in one.suspects}
    assert named == {'insertion'}
    assert 'contradicts the rest (30 mm off)' in {
        one.suspects.get('insertion') for one in estimates
    }
    assert errors[-10:].mean() < 0.002


def stamp_of(sample) -> int:
    return sample.stamp


@pytest.mark.parametrize('shift, weight', [(0.002, 1.0), (0.02, 100.0 / 1600.0)])
def test_the_prior_of_a_base_is_let_go_beyond_its_spread(shift, weight):
    """20 mm are 40 sigmas of 0.5 mm: 100 / 40^2 of the weight is left; 2 mm are 4, and all is."""
    robot = carried('fixed')
    grid = Grid(robot, 0.16)
    priors = Priors(robot, grid, EstimatorSettings())
    T_map_base, rest = np.eye(4), np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1))
    T_map_base[1, 3] = shift
    moved = column_at_rest(grid, T_map_base, rest, 0.0)
    found = symmetric(priors.start(moved).H)
    still = symmetric(priors.start(column_at_rest(grid, np.eye(4), rest, 0.0)).H)
    expected = 0.0005**-2.0 * (weight - 1.0)
    assert (found - still)[1, 1] == pytest.approx(expected, rel=1e-6, abs=1.0)


def test_along_a_smooth_pipe_the_covariance_says_that_nothing_is_seen(monkeypatch):
    """Walls along x alone, whose ends no sensor reaches: sideways it knows, along x it says so."""
    monkeypatch.setattr(worlds, 'ROOM', np.array([[-9.0, -0.7, -0.6], [9.0, 0.8, 0.7]]))
    robot = carried('free', sigma_position=0.001)
    kept = (
        one for one in carried_stream(CarriedRod(robot), 3.0) if not isinstance(one, BaseSample)
    )
    _, estimates, errors, _ = run(robot, kept, room_map(0.05))
    R = np.array([one.T_map_ring[1, :3, :3] for one in estimates])
    P = np.array([one.covariance[1, :3, :3] for one in estimates])
    sigma = np.sqrt(np.diagonal(R @ P @ np.swapaxes(R, 1, 2), axis1=1, axis2=2))  # in map
    assert sigma[-1, 0] > 0.02 > 5.0 * sigma[-1, 1:].max()
    assert sigma[-1, 0] > 2.0 * sigma[0, 0]  # from one second to three
    assert np.all(errors[:, 1] < 3.0 * sigma[:, 0]) and errors[:, 1].max() > 0.02
    _, spread, axis = estimates[-1].least_known
    assert spread > 0.02 and abs(axis[0]) > 0.95


def test_a_measured_base_that_contradicts_the_rest_is_named(prior_map):
    """An arm that is good to 1 mm tells places 2 cm aside: named, and the rings stay right."""
    robot = carried(sigma_position=0.001, sigma_rotation_deg=0.1)
    aside = lie.exp(np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0]))
    samples = carried_stream(CarriedRod(robot), 3.0, lambda time: aside)
    _, estimates, errors, _ = run(robot, samples, prior_map)
    assert estimates[-1].suspects['base'].startswith('is not where it is told to be')
    assert estimates[-1].status == 'doubtful'
    half = len(errors) // 2
    assert errors[half:, 1:].mean() < 0.003


def test_a_late_stamp_is_taken_for_the_instant_that_it_tells_of(prior_map):
    """A pose stamped at 55 ms and told to be 40 ms late is of 15 ms, and of the travel then."""
    insertion = {'mode': 'measured', 'range': [0.0, 0.6], 'sigma': 0.002}
    robot = carried(insertion=insertion, measurement={'latency': 0.04})
    filter_ = SlidingWindowFilter(robot, prior_map)
    rows = [BaseSample(EPOCH + nanoseconds(0.04), 'map', np.eye(4))]
    rows += [
        EncoderSample(EPOCH + nanoseconds(t), ('insertion',), np.array([x]), np.zeros(1))
        for t, x in ((0.045, 0.1), (0.055, 0.2))
    ]
    rows.append(BaseSample(EPOCH + nanoseconds(0.09), 'map', np.eye(4)))
    for sample in rows:
        filter_.process(sample)
    factor = next(one for one in filter_.factors if one.name == 'base')
    interval = filter_.window.intervals[0]
    interval.linearise(filter_.priors, *filter_.window.columns[:2])
    batch = interval._batches[factor]
    # The first sample is of the epoch less its latency, before which there is no window.
    assert batch.times[-1] == pytest.approx(0.01) and len(batch.times) == 1
    assert batch.T_frame_node[-1, 0, 3] == pytest.approx(0.15)
