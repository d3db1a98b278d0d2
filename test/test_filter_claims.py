"""
What the filter says of itself, against what is known without it.

Covariances against draws from the very spreads that were stated, and against the dense solution
of a body that can only slide; what is added for mounts and while lost, by its settings; which body
the search takes, by costs.
"""

from dataclasses import replace

from continuum_loc import lie
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.recovery import SHARE_SLACK, Try
from continuum_loc.estimator.state import column_at_rest, Grid
from continuum_loc.measurements import TofFrame, TrackedPose, TruthSample
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
import numpy as np
import pytest
from scipy.stats import chi2
from test_tof_weights import arm, LENGTH, normal_at, WALL, wall
from worlds import EPOCH, EXACT, Rod, rod, room_map, stream

PERIOD = 0.1  # [s] between knots


@pytest.fixture(scope='module')
def prior_map():
    return room_map(0.05)


# What reaches into the filter stands in these three functions.


def stretch_of(filter_: SlidingWindowFilter, time: float) -> float:
    """Start [s] of the stretch between two knots that a measurement at `time` is put into."""
    return filter_.window.interval_at(time).start


def judge(prior_map):
    """(whether one body is better than the present one, whether one rivals the chosen one)."""
    recovery = SlidingWindowFilter(rod(), prior_map).recovery
    return recovery._beats, recovery._rivals


def body_at(y: float):
    """Lay the rod straight along x, `y` [m] aside."""
    grid, T_map_base = Grid(rod(), EstimatorSettings().node_spacing), np.eye(4)
    T_map_base[1, 3] = y
    rest = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], (grid.nodes, 1))
    return column_at_rest(grid, T_map_base, rest, 0.0)


# ------------------------------------------------------------------ a body that slides along x


def slider() -> RobotDescription:
    """Describe a stiff body whose base slides freely along x, with a tracked coil at its tip."""
    return parse_settings(
        RobotDescription,
        {
            'name': 'slider',
            'length': LENGTH,
            'radius': 0.02,
            'base': {
                'sigma_position': 1e-3,
                'sigma_rotation_deg': 0.1,
                'insertion': {'mode': 'unknown', 'range': [-1.0, 1.0]},
            },
            'backbone': {'rest_strain_sigma': [1e-5] * 6},
            'rings': [{'name': 'tip', 's': LENGTH}],
            'trackers': [{'name': 'coil', 'ring': 'tip'}],
            'tolerances': EXACT,
        },
    )


def slide(times, places, sigma: float, density: float, **changes):
    """
    Track the slider at `places` [m] with the spread `sigma`: the filter and its estimates.

    density: of the white noise on its acceleration [m^2/s^3]. Two nodes, base and tip, carry it
    each, and they move as one, so that half of it is left.
    """
    settings = {
        'node_spacing': 0.3,
        'knot_period': PERIOD,
        'window': 0.5,
        'output_rate': 10.0,
        'prior': {
            'strain': [1e-9] * 6,
            'memory': 1e9,
            'cauchy': 1e6,
            'velocity_slope': [1e-9] * 6,
            'velocity': [2.0 * density] * 6,
        },
        'tracker': {'cauchy': 1e6},
        **changes,
    }
    filter_ = SlidingWindowFilter(slider(), None, parse_settings(EstimatorSettings, settings))
    P, estimates = np.diag([sigma**2] * 3 + [1e-4] * 3), []
    for time, place in zip(times, places, strict=True):
        T = np.eye(4)
        T[0, 3] = LENGTH + place
        stamp = EPOCH + round(time * 1e9)
        estimates.append(filter_.process(TrackedPose(stamp, 'coil', T, P)))
    return filter_, [one for one in estimates if one is not None]


def all_knots(sigma: float, density: float, count: int) -> np.ndarray:
    """
    (2 count, 2 count) covariance of place and velocity at every knot, each tracked to `sigma`.

    A straight line through noise: one dense matrix of white noise on acceleration, inverted.
    """
    F = np.array([[1.0, PERIOD], [0.0, 1.0]])
    Q = density * np.array([[PERIOD**3 / 3, PERIOD**2 / 2], [PERIOD**2 / 2, PERIOD]])
    step = np.hstack([-F, np.eye(2)])
    information = np.diag(np.tile([sigma**-2.0, 0.0], count))
    information[:2, :2] += np.diag([0.25, 1.0])  # what is known at first hardly matters
    for k in range(count - 1):
        at = slice(2 * k, 2 * k + 4)
        information[at, at] += step.T @ np.linalg.inv(Q) @ step
    return np.linalg.inv(information)


@pytest.mark.parametrize(('sigma', 'density'), [(0.003, 0.25), (0.02, 0.01)])
def test_a_sliding_bodys_covariance_is_that_of_all_its_knots_at_once(sigma, density):
    """
    Newest and smoothed, after the window has moved on four times its length.

    What was marginalised is all there, then: a window that forgot would know less, and one that
    counted twice more.
    """
    times = np.arange(0.0, 2.55, PERIOD)
    _, estimates = slide(times, 0.0 * times, sigma, density, lag=0.2)
    variance = np.diag(all_knots(sigma, density, len(estimates)))
    newest, lagged = estimates[-1], estimates[-1].lagged
    for found, (place, velocity) in ((newest, variance[-2:]), (lagged, variance[-6:-4])):
        assert found.covariance[1, 0, 0] == pytest.approx(place, rel=2e-3)
        assert found.velocity_covariance[1, 0, 0] == pytest.approx(velocity, rel=2e-3)


def test_between_knots_a_measurement_is_met_at_its_own_time():
    """
    A body that jolts at random, tracked to 0.1 mm at every knot and midway between.

    Two measurements for each knot's place and velocity: a cubic that passes through them exists,
    and only where each is compared with the stretch that holds its time. Those from between come
    0.1 s late, when the window has moved on.
    """
    times = np.arange(0.0, 1.21, PERIOD / 2.0)
    places = np.cumsum(0.02 * np.random.default_rng(0).normal(size=len(times)))
    arrival = np.argsort(times + PERIOD * (np.arange(len(times)) % 2), kind='stable')
    filter_, _ = slide(times[arrival], places[arrival], 1e-4, 1e3)
    within = (times > 0.75) & (times < 1.12)
    found = [
        filter_.query(EPOCH + round(time * 1e9), LENGTH).T_map_body[0, 3] - LENGTH
        for time in times[within]
    ]
    assert len(found) == 7
    np.testing.assert_allclose(found, places[within], atol=2e-5)


@pytest.mark.parametrize('sigma', [1e-5, 1e-3])
def test_midway_between_knots_a_body_is_known_less(sigma):
    """
    The cubic's middle, (a + b) / 2 + dt (v_a - v_b) / 8, and what noise bends away from it.

    White noise of density q on the acceleration does so by q dt^3 / 192. Every node moves for
    itself between knots, so that q is twice what is left of both at a knot.
    """
    times, density = np.arange(0.0, 1.21, PERIOD), 0.25
    filter_, estimates = slide(times, 0.0 * times, sigma, density)
    middle = np.array([0.5, PERIOD / 8.0, 0.5, -PERIOD / 8.0])
    ends = all_knots(sigma, density, len(estimates))[-6:-2, -6:-2]
    expected = middle @ ends @ middle + 2.0 * density * PERIOD**3 / 192.0
    found = filter_.query(estimates[-3].stamp + 50_000_000, LENGTH)
    assert found.covariance[0, 0] == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ('time', 'start'), [(0.61, 0.6), (0.65, 0.6), (0.69, 0.6), (0.7, 0.6), (0.7001, 0.7)]
)
def test_a_measurement_belongs_to_the_knots_around_it(time, start):
    """The stretch after 0.6 s reaches up to 0.7 s and holds it."""
    times = np.arange(0.0, 0.96, PERIOD / 2.0)
    filter_, _ = slide(times, 0.0 * times, 1e-3, 0.1)
    assert stretch_of(filter_, time) == pytest.approx(start, abs=1e-9)


# ------------------------------------------------------------------ honesty


def test_errors_are_as_large_as_stated_when_base_and_ranges_are_drawn_from_their_spreads():
    """
    300 frames of 64 zones of a slanted wall, each from a base anew and with Table I's noise.

    xi^T P^-1 xi is a chi2 of 6 for each, so that the sum is one of 1800; bounds at 1e-4.
    """
    robot, n = arm(8, base=(3e-3, 0.5)), normal_at(0.8)
    filter_ = SlidingWindowFilter(robot, wall(WALL, 0.8, reach=1.2), only_ranges())
    rng, rays = np.random.default_rng(1), robot.tof_model.directions
    sigma = np.array([3e-3] * 3 + [np.radians(0.5)] * 3)
    tip, total, draws = lie.exp(np.array([LENGTH, 0, 0, 0, 0, 0])), 0.0, 300
    for _ in range(draws):
        T = lie.exp(sigma * rng.normal(size=6)) @ tip
        beams = rays @ T[:3, :3].T
        distance = n @ (np.array([LENGTH + WALL, 0.0, 0.0]) - T[:3, 3]) / (beams @ n)
        noise = np.interp(distance, [0.6, 1.2], [0.012, 0.006]) * distance
        measured = distance + noise * rng.normal(size=len(rays))
        status = np.full(len(rays), 5, np.uint8)
        filter_.reset()
        found = filter_.process(
            TofFrame(EPOCH, 'eye', measured[:, None] * rays, measured, noise, status)
        )
        xi = lie.log(lie.inverse(found.T_map_ring[1]) @ T)
        total += xi @ np.linalg.solve(found.covariance[1], xi)
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], 6 * draws)
    assert low < total < high


def only_ranges() -> EstimatorSettings:
    """Nothing but the base's spread and the ranges' noise, and no loss, as there is no outlier."""
    prior = {'strain': [1e-9] * 6, 'initial_velocity_sigma': [1e-6, 1e-6], 'memory': 1e9}
    tof = {'floor': 0.0, 'cauchy': 1e6, 'acquisition_cauchy': 1e6}
    changes = {'recovery': {'enabled': False}, 'prior': prior, 'tof': tof}
    return parse_settings(EstimatorSettings, changes)


def test_a_moving_rod_is_told_as_well_as_it_is_known():
    """
    Three rods that bend and turn, with the datasheet's noise and no outliers.

    The process noise is what these motions show from knot to knot, and the description says that
    the curvature steps at 0.3 m. NEES and coverage have the bounds that the studies claim.
    """
    normalised = np.concatenate([nees_of_a_rod(seed) for seed in range(3)])
    assert len(normalised) == 3 * 82
    assert 0.7 < np.mean(normalised) / 6.0 < 1.5
    assert 0.90 < np.mean(normalised <= chi2.ppf(0.95, 6)) < 0.98


def nees_of_a_rod(seed: int) -> np.ndarray:
    """xi^T P^-1 xi of both rings, at each estimate after the first third of a second."""
    data = rod().model_dump()
    data['backbone'] = {
        'rest_strain_sigma': (1e-3, 1e-3, 1e-3, 1e-2, 0.6, 0.6),
        'module_ends': (0.3,),
    }
    robot = parse_settings(RobotDescription, data)
    filter_ = SlidingWindowFilter(robot, room_map(), as_it_moves(Rod(robot, seed=seed)))
    truth, found = {}, []
    for sample in stream(Rod(robot, seed=seed), 3.0, seed=seed):
        if isinstance(sample, TruthSample):
            truth[sample.stamp] = sample.T_map_ring
        elif (estimate := filter_.process(sample)) and estimate.stamp in truth:
            xi = lie.log(lie.inverse(estimate.T_map_ring) @ truth[estimate.stamp])[1:]
            found.append(np.einsum('ri,rij,rj->r', xi, np.linalg.inv(estimate.covariance[1:]), xi))
    return np.concatenate(found[5:])


def as_it_moves(motion: Rod) -> EstimatorSettings:
    """Densities of what a rod's velocity and curvature change by between knots; no loss."""
    times = np.arange(0.0, 3.0, PERIOD)
    velocity = np.array([motion.rates(time)[1:] for time in times])
    bend = np.array([motion.curvature(time) for time in times])
    q_velocity = np.mean(np.diff(velocity, axis=0) ** 2, axis=(0, 1)) / PERIOD
    q_bend = float(np.mean(np.diff(bend, axis=0) ** 2) / PERIOD)
    step = float(np.sqrt(np.mean((bend[:, 0] - bend[:, 1]) ** 2)))
    return parse_settings(
        EstimatorSettings,
        {
            'window': 0.6,
            'lag': 0.2,
            'prior': {
                'velocity': np.maximum(q_velocity, 1e-6).tolist(),
                'strain_rate': [1e-6] * 4 + [q_bend] * 2,
                'strain': [1e-8, 1e-8, 1e-8, 1e-6, 1e-2, 1e-2],
                'strain_step': [0.0] * 4 + [step] * 2,
            },
            'tof': {'floor': 1e-6, 'cauchy': 100.0},
            'gyro': {'scale': 1.0, 'cauchy': 1e3},
            'strain': {'scale': 1.0, 'cauchy': 100.0},
        },
    )


# ------------------------------------------------------------------ what is added to a covariance


def covariances(samples, prior_map, **changes) -> list:
    """Make the estimates of a filter over samples, with small and quick searches."""
    recovery = {'max_curvature': 2.0, 'curvature_step': 1.0, 'beam': 6, 'refined': 3}
    recovery |= changes.pop('recovery', {})
    settings = parse_settings(
        EstimatorSettings, {'window': 0.6, 'lag': 0.2, 'recovery': recovery, **changes}
    )
    filter_ = SlidingWindowFilter(rod(strain=False), prior_map, settings)
    made = [filter_.process(sample) for sample in samples if not isinstance(sample, TruthSample)]
    return [one for one in made if one is not None]


def test_what_mounts_may_be_off_by_is_added_at_every_ring(prior_map):
    """4 mm and 0.02 rad to every ring's covariance, smoothed ones too; the base has no mount."""
    samples = list(stream(Rod(rod(strain=False)), 0.6))
    plain, wider = (
        covariances(samples, prior_map, calibration_sigma=sigma)
        for sigma in ((0.0, 0.0), (0.004, 0.02))
    )
    added = np.diag([16e-6] * 3 + [4e-4] * 3)
    for a, b in zip(plain, wider, strict=True):
        np.testing.assert_array_equal(a.T_map_ring, b.T_map_ring)
        np.testing.assert_array_equal(b.covariance[0], a.covariance[0])
        for ring in (1, 2):
            np.testing.assert_allclose(b.covariance[ring], a.covariance[ring] + added, atol=1e-14)
    np.testing.assert_allclose(
        wider[-1].lagged.covariance[2], plain[-1].lagged.covariance[2] + added, atol=1e-14
    )


def test_a_body_that_is_lost_says_how_far_it_may_be(prior_map):
    """
    From 0.5 s on the ranges are drawn at random, so that every body fits as badly as another.

    A lost tip may be 0.2 m and 0.4 rad off beyond its covariance, the ring midway half of that,
    the base not at all; and it says so from the moment of suspicion.
    """
    robot, rng, samples = rod(strain=False), np.random.default_rng(0), []
    for sample in stream(Rod(robot), 1.2):
        if isinstance(sample, TofFrame) and sample.stamp - EPOCH > 0.5e9:
            ranges = rng.uniform(0.2, 0.6, 64)
            points = robot.tof_model.directions * ranges[:, None]
            sample = replace(sample, points=points, ranges=ranges)
        samples.append(sample)
    plain, wider = (
        covariances(samples, prior_map, recovery={'lost_sigma': sigma})
        for sigma in ((0.0, 0.0), (0.2, 0.4))
    )
    grown = {
        status: np.array(
            [
                np.diagonal(b.covariance - a.covariance, axis1=1, axis2=2)
                for a, b in zip(plain, wider, strict=True)
                if b.status == status
            ]
        )
        for status in ('tracking', 'lost')
    }
    full = np.array([0.04] * 3 + [0.16] * 3)
    assert len(grown['lost']) >= 4
    np.testing.assert_allclose(grown['lost'][:, 2], np.tile(full, (len(grown['lost']), 1)))
    np.testing.assert_allclose(grown['lost'][:, 1], np.tile(full / 4, (len(grown['lost']), 1)))
    assert np.all(grown['lost'][:, 0] == 0.0)
    before, suspected = grown['tracking'][:5], grown['tracking'][-3:]
    assert np.all(before == 0.0)
    assert np.all((suspected[:, 2] > 0.8 * full) & (suspected[:, 2] <= full * (1.0 + 1e-9)))


# ------------------------------------------------------------------ which body the search takes

MINE = Try(100.0, 0.80, 5, [])


@pytest.mark.parametrize(
    ('cost', 'share', 'whole', 'better'),
    [
        (90.0, 0.90, 5, True),  # a margin of a tenth: 90 and a tenth of it is less than 100
        (92.0, 0.90, 5, False),
        (95.0, 0.90, 5, False),
        (105.0, 0.90, 5, False),
        (50.0, 0.81, 5, False),  # less than the slack of 0.02 more of its zones fit
        (50.0, 0.90, 4, False),  # fewer sensors fit wholly
    ],
)
def test_a_body_is_left_only_for_one_that_is_clearly_better(prior_map, cost, share, whole, better):
    beats, _ = judge(prior_map)
    assert beats(Try(cost, share, whole, []), MINE, SHARE_SLACK) is better


@pytest.mark.parametrize(
    ('apart', 'cost', 'share', 'whole', 'rival'),
    [
        (0.05, 90.0, 0.80, 5, True),
        (0.05, 105.0, 0.80, 5, True),  # costs no more than a tenth more
        (0.05, 115.0, 0.80, 5, False),
        (0.05, 105.0, 0.79, 5, True),  # within the slack of 0.02
        (0.05, 105.0, 0.77, 5, False),
        (0.05, 105.0, 0.80, 4, False),
        (0.02, 90.0, 0.80, 5, False),  # within 3 cm it is the same body
    ],
)
def test_a_body_elsewhere_that_explains_as_much_is_a_rival(
    prior_map, apart, cost, share, whole, rival
):
    _, rivals = judge(prior_map)
    here, there = (
        replace(MINE, cost=c, share=s, whole=w, columns=[body_at(y)])
        for c, s, w, y in ((100.0, 0.80, 5, 0.0), (cost, share, whole, apart))
    )
    assert bool(rivals(there, here)) is rival
