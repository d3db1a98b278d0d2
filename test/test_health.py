"""Sensor health: what clocks and zones tell, and who is blamed in an analytic world."""

from continuum_loc import lie
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.clocks import ClockEvidence
from continuum_loc.estimator.factors.gyro import judge
from continuum_loc.estimator.interpolation import rattle_covariance
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.state import Grid
from continuum_loc.measurements import TruthSample
from continuum_loc.offline.trials import _base_drawn
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
from continuum_loc.simulator.faults import ClockOffset, Outliers
import numpy as np
import pytest
from test_factors import columns, DT, make_factor, measurements, robot
from worlds import Rod, rod, room_map, stream

STEP = 1e-5  # [s]


@pytest.mark.parametrize('kind', ['tof', 'gyro'])
@pytest.mark.parametrize('seed', range(2))
def test_clock_scores_are_derivatives_by_the_stamps(kind, seed):
    """
    Moving a sensor's stamps changes the cost as its score says.

    The coupling is how that slope changes with the state: the mixed second derivative in the
    Gauss-Newton sense, which along the motion itself is the slope of the gradient.
    """
    description = robot()
    grid = Grid(description, 0.16)
    factor = make_factor(kind, description, grid)
    rows = [factor.row(m) for m in measurements(kind, description)]
    times = np.linspace(0.2, 0.8, len(rows)) * DT
    a, b = columns(grid, seed)
    batch = factor.stack(times, rows)
    factor.linearise(batch, a, b, Normal.zeros(2 * grid.dim))
    scores = factor.clock_scores(batch, a, b)
    which = batch.sensors if kind == 'tof' else batch.imus
    for number in range(len(factor.sensors)):
        late = [
            batch._replace(times=batch.times + sign * STEP * (which == number))
            for sign in (1.0, -1.0)
        ]
        cost = [factor.linearise(one, a, b, Normal.zeros(2 * grid.dim)).squared for one in late]
        slope = (cost[0] - cost[1]) / (4.0 * STEP)
        assert slope == pytest.approx(scores.gradient[number, 0], rel=2e-3, abs=1e-6)
        assert scores.information[number, 0, 0] > 0.0


def blamed(fault=None, seed=3, duration=5.0):
    """Sensors that a filter blames at any time, and its largest error [m]."""
    settings = parse_settings(
        EstimatorSettings, {'knot_period': 0.1, 'window': 1.0, 'health': {'clock_period': 0.2}}
    )
    filter_ = SlidingWindowFilter(rod(), room_map(), settings)
    reasons: dict[str, str] = {}
    samples = stream(Rod(rod(), seed=seed), duration)
    truth, error = {}, 0.0
    for sample in fault(samples) if fault else samples:
        if isinstance(sample, TruthSample):
            truth[sample.stamp] = sample.T_map_ring
            continue
        estimate = filter_.process(sample)
        if estimate is not None:
            reasons |= estimate.suspects
            if estimate.stamp in truth:
                off = estimate.T_map_ring[:, :3, 3] - truth[estimate.stamp][:, :3, 3]
                error = max(error, float(np.linalg.norm(off, axis=1).max()))
    return reasons, error


def test_nobody_is_blamed_for_nothing():
    reasons, _ = blamed()
    assert reasons == {}


def test_a_late_ring_is_named_and_by_how_much():
    """A ring's ToF frames 60 ms late: its sensors are named, no other, and about how late."""
    late = ClockOffset(sensors=('r2_tof*',), start=2.0, offset=0.06)
    reasons, error = blamed(late)
    assert set(reasons) == {'r2_tof0', 'r2_tof1', 'r2_tof2'}
    assert all(reason.endswith('ms late') for reason in reasons.values())
    told = [float(reason.split()[0]) for reason in reasons.values()]
    assert 20.0 < min(told) <= max(told) < 80.0
    assert np.mean(told) == pytest.approx(60.0, rel=0.4)
    assert error < 0.03


def test_a_late_gyro_is_told_from_tof_that_is_early():
    reasons, _ = blamed(ClockOffset(sensors=('r2_imu',), start=2.0, offset=0.06))
    assert set(reasons) == {'r2_imu'}
    assert reasons['r2_imu'].endswith('ms late')


def test_a_noisy_sensor_is_named():
    """Outliers change from frame to frame; something new in the scene does not."""
    noisy = Outliers(sensors=('r1_tof1',), start=2.0, probability=0.3)
    reasons, error = blamed(noisy)
    assert reasons == {'r1_tof1': 'noisy'}
    assert error < 0.01


def test_rattle_is_the_angle_that_residual_rates_integrate_to():
    """Residuals A sin(w t) turn the body by A / w, with variance A^2 / (2 w^2)."""
    description = robot()
    factor = make_factor('gyro', description, Grid(description, 0.16))
    times = np.arange(0.0, 1.0, 0.005)
    rng, sigma = np.random.default_rng(0), factor.information**-0.5
    omega, amplitude = 2.0 * np.pi * 9.0, 60.0 * sigma

    def rattle_of(residuals):
        fits, rattle = np.zeros((1, 2)), np.zeros((1, 3))
        judge(times, np.zeros(len(times), int), residuals, factor.information, fits, rattle)
        return rattle[0]

    noise = sigma * rng.normal(size=(len(times), 3))
    swing = amplitude * np.sin(omega * times)[:, None] * [0.0, 1.0, 0.5]
    variance = rattle_of(swing + noise)
    assert variance[1] == pytest.approx(amplitude**2 / (2.0 * omega**2), rel=0.1)
    assert variance[2] == pytest.approx(variance[1] / 4.0, rel=0.2)
    walks = [rattle_of(sigma * rng.normal(size=(len(times), 3))) for _ in range(50)]
    assert np.mean(walks) < 0.02 * variance[2]


def test_turns_move_what_is_beyond_them_sideways():
    """A body that turns by 1 mrad about z everywhere beyond s = 0.1 m moves along y as it does."""
    turns = np.tile([0.0, 0.0, 1e-3], (2, 1))
    P = rattle_covariance(np.array([0.1, 0.6]), turns, np.array([0.0, 0.1, 0.6]))
    np.testing.assert_allclose(np.sqrt(P[:, 5, 5]), [0.0, 1e-3, 1e-3])
    np.testing.assert_allclose(np.sqrt(P[:, 1, 1]), [0.0, 0.5e-4, 5.5e-4])
    assert np.all(P[:, 2, 2] == 0.0)


def test_strain_may_step_where_a_module_ends():
    """The rod's curvature steps at 0.3 m: told so, strain alone leads to its tip more closely."""
    off = []
    for ends in ((), (0.3,)):
        data = rod(tof=False).model_dump()
        data['backbone']['module_ends'] = ends
        data['imu'] = []
        description = parse_settings(RobotDescription, data)
        filter_ = SlidingWindowFilter(description, None, EstimatorSettings(knot_period=0.1))
        truth, errors = {}, []
        for sample in stream(Rod(description, seed=4, amplitude=3.0), 3.0):
            if isinstance(sample, TruthSample):
                truth[sample.stamp] = sample.T_map_ring
            elif (estimate := filter_.process(sample)) and estimate.stamp in truth:
                gap = estimate.T_map_ring[-1, :3, 3] - truth[estimate.stamp][-1, :3, 3]
                errors.append(np.linalg.norm(gap))
        off.append(np.mean(errors[5:]))
    assert off[1] < 0.5 * off[0]


def test_a_drawn_base_keeps_the_spread_of_the_description():
    description = robot()
    base, sigma = description.base, description.base.sigma_position
    moved = np.array([_base_drawn(description, seed).base.T_map_base for seed in range(300)])
    shift = (lie.inverse(base.T_map_base) @ moved)[:, :3, 3]
    np.testing.assert_allclose(shift.std(axis=0), sigma, rtol=0.15)
    np.testing.assert_array_equal(moved[7], _base_drawn(description, 7).base.T_map_base)


def test_an_offset_beyond_the_first_order_is_no_clock():
    """Half a second is what a hit body's residuals ask for; its neighbour's 50 ms are told."""
    information = np.array([2e4, 3e4])
    gradient = information * np.array([-0.5, 0.05])
    evidence = ClockEvidence(
        ['struck', 'late'],
        gradient,
        np.diag(information),
        np.column_stack([gradient, information]),
        np.zeros((2, 2)),
        np.ones(2),
    )
    told = evidence.offsets([('struck',), ('late',)], 0.025, 5.0)
    assert [one.sensors for one in told] == [('late',)]
    assert told[0].offset == pytest.approx(-0.05)
