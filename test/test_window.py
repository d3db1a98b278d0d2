"""The filter as a whole in an analytic world: accuracy, honesty, bad data, lost and found."""

from dataclasses import dataclass, replace
from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.estimator import (
    EstimatorSettings,
    load_estimator_settings,
    SlidingWindowFilter,
    smooth,
)
from continuum_loc.estimator import (
    filter as filter_module,
)
from continuum_loc.estimator.factors import Factor, FactorReport, FACTORS, Setup
from continuum_loc.estimator.factors.gyro import GyroFactor
from continuum_loc.estimator.interpolation import interpolated
from continuum_loc.estimator.normal import add_rows
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.recovery import SHARE_SLACK, Try
from continuum_loc.estimator.solver import track
from continuum_loc.estimator.state import column_at_rest, Grid, rows_in_time
from continuum_loc.estimator.window import Window
from continuum_loc.measurements import ImuSample, StrainSample, TofFrame, TrackedPose, TruthSample
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.settings import parse_settings
from continuum_loc.simulator.world import World
import numpy as np
import pytest
from worlds import EPOCH, Rod, rod, room_map, stream


@pytest.fixture(scope='module')
def prior_map():
    return room_map()


def settings(**changes) -> EstimatorSettings:
    return parse_settings(
        EstimatorSettings, {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2, **changes}
    )


def run(filter_: SlidingWindowFilter, samples) -> tuple[list, dict]:
    estimates, truth = [], {}
    for sample in samples:
        if isinstance(sample, TruthSample):
            truth[sample.stamp] = sample.T_map_ring
            continue
        estimate = filter_.process(sample)
        if estimate is not None:
            estimates.append(estimate)
    return estimates, truth


def errors(estimates, truth) -> np.ndarray:
    """(K, R + 1, 6) body-frame pose errors of the estimates with a true pose at their stamp."""
    return np.array(
        [
            lie.log(lie.inverse(e.T_map_ring) @ truth[e.stamp])
            for e in estimates
            if e.stamp in truth
        ]
    )


def test_tracks_the_rod(prior_map):
    robot = rod()
    estimates, truth = run(
        SlidingWindowFilter(robot, prior_map, settings()), stream(Rod(robot), 3.0)
    )
    e = errors(estimates, truth)[5:, 1:]
    assert len(estimates) == 46
    assert np.sqrt(np.mean(e[..., :3] ** 2)) < 2e-3
    assert np.degrees(np.sqrt(np.mean(e[..., 3:] ** 2))) < 0.3
    assert all(x.status == 'tracking' for x in estimates[5:])


def test_velocity_is_the_bodys(prior_map):
    robot = rod()
    motion = Rod(robot, seed=2)
    estimates, _ = run(SlidingWindowFilter(robot, prior_map, settings()), stream(motion, 3.0))
    e = np.array([x.velocity - motion.rates((x.stamp - EPOCH) / 1e9) for x in estimates[15:]])[
        :, 1:
    ]
    assert np.sqrt(np.mean(e[..., :3] ** 2)) < 0.02
    assert np.sqrt(np.mean(e[..., 3:] ** 2)) < 0.05


def test_the_smoothed_estimate_is_the_better_one(prior_map):
    robot = rod()
    estimates, truth = run(
        SlidingWindowFilter(robot, prior_map, settings(lag=0.2)), stream(Rod(robot, seed=1), 3.0)
    )
    lagged = [x.lagged for x in estimates if x.lagged is not None]
    lagged = [x for x in lagged if x.stamp in truth][3:]
    assert len(lagged) > 20
    smoothed = np.sqrt(np.mean(errors(lagged, truth)[:, 1:, :3] ** 2))
    newest = np.sqrt(np.mean(errors(estimates[6:], truth)[:, 1:, :3] ** 2))
    assert smoothed < newest


def test_the_same_measurements_give_the_same_estimate(prior_map):
    robot = rod()
    first, second = (
        run(SlidingWindowFilter(robot, prior_map, settings()), stream(Rod(robot), 1.5))[0]
        for _ in range(2)
    )
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.T_map_ring, b.T_map_ring)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_a_filter_after_reset_is_as_a_new_one(prior_map):
    """It forgets a frozen sensor's last frame, whom it did not believe, and where the body was."""
    robot, turn = rod(), lie.exp(np.radians([0, 0, 0, 0, 0, 20.0]))[:3, :3]
    clean, disturbed, first = list(stream(Rod(robot, seed=6), 1.5)), [], {}
    for s in clean:
        if isinstance(s, TofFrame) and s.sensor == 'r1_tof0':
            s = replace(first.setdefault('frame', s), stamp=s.stamp)
        if isinstance(s, TofFrame) and s.sensor == 'r2_tof1':
            s = replace(s, points=s.points @ turn.T)
        disturbed.append(s)
    used, new = (SlidingWindowFilter(robot, prior_map, settings()) for _ in range(2))
    suspects = run(used, disturbed)[0][-1].suspects
    assert set(suspects) == {'r1_tof0', 'r2_tof1'}
    before = used.counts['dropped'].copy()
    used.reset()
    again, fresh = (run(filter_, clean)[0] for filter_ in (used, new))
    assert used.counts['dropped'] == before
    for a, b in zip(again, fresh, strict=True):
        assert (a.stamp, a.status, a.suspects, a.inliers) == (
            b.stamp,
            b.status,
            b.suspects,
            b.inliers,
        )
        np.testing.assert_array_equal(a.T_map_ring, b.T_map_ring)
        np.testing.assert_array_equal(a.covariance, b.covariance)
        np.testing.assert_array_equal(a.lagged is None, b.lagged is None)
    for time in (0.3, 1.2):
        one, other = (f.query(EPOCH + round(time * 1e9), 0.4) for f in (used, new))
        np.testing.assert_array_equal(one.covariance, other.covariance)


@dataclass(frozen=True)
class Height:
    """How high the tip is: the sample of a sensor that the package does not know."""

    stamp: int
    z: float


class HeightRow(NamedTuple):
    z: float


class HeightBatch(NamedTuple):
    times: np.ndarray
    z: np.ndarray


class HeightFactor(Factor):
    name = 'height'
    consumes = Height
    batch = HeightBatch
    sigma = 1e-3

    def row(self, measurement):
        return HeightRow(measurement.z)

    def linearise(self, batch, a, b, normal):
        tip = np.full(len(batch.z), self.grid.nodes - 1)
        at, index = interpolated(a, b, batch.times, tip, pose=True), np.empty(24, np.int64)
        rows_in_time(self.grid.nodes - 1, self.grid.dim, index)
        squared = 0.0
        for m, z in enumerate(batch.z):
            J = at.T[m, 2, :3] @ at.J_pose[m, :3]  # dz = e_z^T R rho
            e = np.array([at.T[m, 2, 3] - z])
            squared += add_rows(normal, index, e, J[None], np.full(1, self.sigma**-2.0))
        return FactorReport(0.5 * squared, squared, len(batch.z))


def test_a_sensor_of_ones_own_is_a_factor_and_an_entry(monkeypatch):
    """Told its tip's height to 1 mm ten times a second, a blind arm knows it to less than that."""
    monkeypatch.setattr(filter_module, 'FACTORS', (*FACTORS, HeightFactor))
    robot = rod(strain=False, tof=False)
    filter_ = SlidingWindowFilter(robot, None, settings())
    for k in range(20):
        filter_.process(Height(EPOCH + k * 100_000_000, 0.02))
    estimate = filter_.flush()
    assert filter_.counts['used']['Height'] == 20
    up = estimate.T_map_ring[-1, 2, :3]  # e_z in the tip's frame
    assert estimate.T_map_ring[-1, 2, 3] == pytest.approx(0.02, abs=1e-3)
    assert up @ estimate.covariance[-1, :3, :3] @ up < HeightFactor.sigma**2


def test_order_within_the_window_does_not_matter_and_older_data_is_dropped_and_counted(prior_map):
    """A gyro that reports 50 ms late is still used; a sample from before the window is not."""
    robot = rod()
    samples = list(stream(Rod(robot), 2.0))
    late = [
        replace(s, stamp=s.stamp)
        for s in samples
        if isinstance(s, ImuSample) and s.sensor == 'r1_imu'
    ]
    others = [s for s in samples if not (isinstance(s, ImuSample) and s.sensor == 'r1_imu')]
    mixed = sorted(others + late, key=lambda s: s.stamp + (50_000_000 if s in late else 0))
    filter_ = SlidingWindowFilter(robot, prior_map, settings())
    estimates, truth = run(filter_, mixed)
    assert filter_.counts['used']['ImuSample'] == sum(isinstance(s, ImuSample) for s in samples)
    assert np.max(np.abs(errors(estimates, truth)[5:, 1:, :3])) < 0.01
    filter_.process(samples[1])
    assert filter_.counts['dropped']['older than the window'] == 1


def test_unusable_measurements_are_counted_and_harmless(prior_map):
    robot = rod()
    filter_ = SlidingWindowFilter(robot, prior_map, settings())
    samples = list(stream(Rod(robot), 1.0))
    frame = next(s for s in samples if isinstance(s, TofFrame))
    imu = next(s for s in samples if isinstance(s, ImuSample))
    bad = [
        replace(frame, sensor='nobody'),
        replace(frame, points=frame.points[:10]),
        replace(imu, angular_velocity=np.array([np.nan, 0.0, 0.0])),
        replace(imu, angular_velocity=np.array([50.0, 0.0, 0.0])),
    ]
    for sample in bad:
        assert filter_.process(sample) is None
    estimates, truth = run(filter_, samples)
    assert dict(filter_.counts['dropped']) == {
        'tof: unknown frame': 1,
        'tof: wrong size': 1,
        'gyro: not finite': 1,
        'gyro: saturated': 1,
    }
    assert np.max(np.abs(errors(estimates, truth)[:, 1:, :3])) < 0.01


def test_invalid_zones_carry_no_information(prior_map):
    robot = rod()
    nothing = [
        replace(s, status=np.full(64, 255, np.uint8)) if isinstance(s, TofFrame) else s
        for s in stream(Rod(robot), 1.0)
    ]
    with_zones, _ = run(SlidingWindowFilter(robot, prior_map, settings()), stream(Rod(robot), 1.0))
    without, _ = run(SlidingWindowFilter(robot, prior_map, settings()), nothing)
    assert without[-1].covariance[2, 0, 0] > 4.0 * with_zones[-1].covariance[2, 0, 0]


def test_a_gap_is_bridged_with_growing_covariance(prior_map):
    """
    Half a second with gyros alone.

    The covariance grows, the error stays inside it, and both shrink again.
    """
    robot = rod()
    samples = [
        s
        for s in stream(Rod(robot), 3.0)
        if isinstance(s, ImuSample | TruthSample) or not 1.0 < (s.stamp - EPOCH) / 1e9 < 1.5
    ]
    estimates, truth = run(SlidingWindowFilter(robot, prior_map, settings()), samples)
    times = np.array([(e.stamp - EPOCH) / 1e9 for e in estimates])
    spread = np.array([np.sqrt(np.trace(e.covariance[2, :3, :3])) for e in estimates])
    before, during, after = (
        spread[(times > a) & (times < b)] for a, b in ((0.6, 1.0), (1.3, 1.5), (2.0, 3.0))
    )
    assert np.max(during) > 3.0 * np.max(before)
    assert np.median(after) < 1.5 * np.median(before)
    assert np.max(np.abs(errors(estimates, truth)[-10:, 1:, :3])) < 0.01


def test_gyro_bias_is_found_at_rest(prior_map):
    """
    Within four sigmas of the rest's mean.

    0.01 rad/s over 50 samples, and 0.002 rad/s for rest not being rest.
    """
    robot = rod()
    bias = {'r1_imu': np.array([0.05, -0.06, 0.04]), 'r2_imu': np.array([-0.05, 0.06, 0.045])}
    biased = [
        replace(s, angular_velocity=s.angular_velocity + bias[s.sensor])
        if isinstance(s, ImuSample)
        else s
        for s in stream(Rod(robot), 2.0)
    ]
    filter_ = SlidingWindowFilter(robot, prior_map, settings(gyro={'bias_sigma': 0.1}))
    run(filter_, biased)
    estimate = filter_.window.column(-1).bias
    np.testing.assert_allclose(
        estimate, np.array(list(bias.values())), atol=4.0 * np.hypot(0.01 / np.sqrt(50), 0.002)
    )


@pytest.mark.parametrize('seed', range(3))
def test_finds_itself_from_the_base_alone(prior_map, seed):
    """
    Without strain and bent from the first moment.

    The search along the body must find the shape.
    """
    robot = rod(strain=False)
    motion = Rod(robot, seed=seed, amplitude=1.8)
    filter_ = SlidingWindowFilter(robot, prior_map, settings(recovery={'max_curvature': 2.0}))
    estimates, truth = run(filter_, stream(motion, 1.0, start=2.0))
    assert np.max(np.abs(errors(estimates, truth)[-5:, 1:, :3])) < 0.01


def test_finds_itself_with_a_ring_on_the_base(prior_map):
    """A ring at s = 0, as a tracker of the base has, leaves the search no segment before it."""
    plain = rod(strain=False)
    data = plain.model_dump()
    data['rings'] = [{'name': 'r0', 's': 0.0}, *data['rings']]
    data['trackers'] = [{'name': 'coil', 'ring': 'r0'}]
    robot = parse_settings(RobotDescription, data)
    filter_ = SlidingWindowFilter(robot, prior_map, settings(recovery={'max_curvature': 2.0}))
    T_ring_coil, samples = robot.trackers[0].mount.T_ring_sensor, []
    for sample in stream(Rod(plain, seed=1, amplitude=1.8), 1.0, start=2.0):
        samples.append(sample)
        if isinstance(sample, TruthSample):
            coil = sample.T_map_ring[0] @ T_ring_coil
            samples.append(TrackedPose(sample.stamp, 'coil', coil))
    estimates, truth = run(filter_, samples)
    last = [e for e in estimates if e.stamp in truth][-5:]
    off = [e.T_map_ring[[0, 2, 3], :3, 3] - truth[e.stamp][:, :3, 3] for e in last]
    assert np.max(np.abs(off)) < 0.01


def test_an_estimate_that_is_called_converged_stays_where_it_is_when_solved_on(prior_map):
    """Convergence is judged at the estimate's stamp, not at the column ahead of the data."""
    robot, moved = rod(), []
    patient = {'relinearise': 1e-9, 'max_iterations': 4}
    filter_ = SlidingWindowFilter(robot, prior_map, settings(solver=patient))
    for sample in stream(Rod(robot, amplitude=2.0), 3.0):
        estimate = None if isinstance(sample, TruthSample) else filter_.process(sample)
        if estimate is not None and estimate.converged:
            track(filter_.window)
            later = filter_.window.body((estimate.stamp - filter_.epoch) / 1e9)
            step = lie.log(lie.inverse(estimate.T_map_ring) @ later.T[filter_.grid.ring_nodes])
            moved.append(np.abs(step).max())
    assert len(moved) > 30
    settled = moved[10:]  # the biases that the initial rest tells enter after a solve
    assert max(settled) < 2.0 * filter_.settings.solver.tolerance


def test_a_tracked_body_is_not_left_for_one_that_fits_no_more(prior_map):
    """It would jump to a rival where the map lacks something: cost alone tells too little."""
    recovery = SlidingWindowFilter(rod(), prior_map, settings()).recovery
    mine, rival = Try(1246.0, 0.853, 7, []), Try(1101.0, 0.858, 7, [])
    better = replace(rival, share=0.93)
    assert recovery._beats(better, mine, SHARE_SLACK)
    assert not recovery._beats(rival, mine, SHARE_SLACK)
    assert recovery._beats(rival, mine, 0.0)  # which one a body that is still sought may take
    assert not recovery._beats(replace(better, whole=6), mine, 0.0)


def test_memory_is_bounded(prior_map):
    robot = rod()
    filter_ = SlidingWindowFilter(robot, prior_map, settings())
    sizes = []
    for sample in stream(Rod(robot), 3.0):
        if not isinstance(sample, TruthSample) and filter_.process(sample):
            sizes.append(len(filter_.window.columns))
    assert max(sizes[10:]) - min(sizes[10:]) <= 1
    assert max(sizes) <= 9


def test_queries_agree_with_the_estimate_and_reach_behind_and_ahead(prior_map):
    """
    Any time and arclength can be asked for.

    Rings as published, truth within 4 sigmas between them, growth ahead of the window.
    """
    robot = rod()
    motion = Rod(robot, seed=4)
    filter_ = SlidingWindowFilter(robot, prior_map, settings())
    estimates, _ = run(filter_, stream(motion, 3.0))
    newest = estimates[-1]
    state = filter_.query(newest.stamp, 0.3)
    np.testing.assert_allclose(state.T_map_body, newest.T_map_ring[1], atol=1e-9)
    np.testing.assert_allclose(
        state.covariance[:6, :6], newest.covariance[1], rtol=1e-6, atol=1e-15
    )
    for time in (0.7, 1.4, 2.5, 2.9):
        for s in (0.1, 0.25, 0.4, 0.55):
            state = filter_.query(EPOCH + round(time * 1e9), s)
            e = lie.log(lie.inverse(state.T_map_body) @ motion.poses(time, np.array([s]))[0])
            assert np.all(np.abs(e) < 4.0 * np.sqrt(np.diag(state.covariance)[:6]) + 1e-6)
            assert np.linalg.eigvalsh(state.covariance)[0] > 0.0
    later = [filter_.query(newest.stamp + round(dt * 1e9), 0.6) for dt in (0.0, 0.3, 0.6)]
    spreads = [np.trace(state.covariance[:3, :3]) for state in later]
    assert spreads[0] < spreads[1] < spreads[2]
    with pytest.raises(ValueError, match='off the body; valid: 0 to 0.6 m'):
        filter_.query(newest.stamp, 0.7)


def test_the_batch_smoother_beats_the_filter(prior_map):
    robot = rod()
    samples = list(stream(Rod(robot, seed=5), 2.5))
    estimates, truth = run(SlidingWindowFilter(robot, prior_map, settings()), samples)
    measurements = [s for s in samples if not isinstance(s, TruthSample)]
    stamps = [e.stamp for e in estimates[8:]]
    smoothed = smooth(robot, prior_map, settings(), measurements, stamps)
    rms = [np.sqrt(np.mean(errors(x, truth)[:, 1:, :3] ** 2)) for x in (smoothed, estimates[8:])]
    assert rms[0] < rms[1]


def test_a_frozen_sensor_is_refused_and_a_wrong_extrinsic_named(prior_map):
    """Neither a sensor that repeats itself nor one mounted 20 degrees off does any harm."""
    robot = rod()
    turn = lie.exp(np.radians([0, 0, 0, 0, 0, 20.0]))[:3, :3]
    first: dict = {}
    samples = []
    for s in stream(Rod(robot, seed=6), 2.0):
        if isinstance(s, TofFrame) and s.sensor == 'r1_tof0':
            s = replace(first.setdefault('frame', s), stamp=s.stamp)
        if isinstance(s, TofFrame) and s.sensor == 'r2_tof1':
            s = replace(s, points=s.points @ turn.T)
        samples.append(s)
    filter_ = SlidingWindowFilter(robot, prior_map, settings())
    estimates, truth = run(filter_, samples)
    assert filter_.counts['dropped']['tof: frozen'] > 20
    assert set(estimates[-1].suspects) == {'r1_tof0', 'r2_tof1'}
    assert np.max(np.abs(errors(estimates, truth)[-10:, 1:, :3])) < 0.01


def test_field_gravity_and_gyros_track_the_hall_arm():
    """
    The arm of the second paper, bent freely by its tendons.

    No map, no strain, only the magnet at its base.

    Told Earth's field it is good to 0.2 mm; not told, ten times worse, as Earth's is a tenth of
    the magnet's.
    """
    robot = load_robot('hall_arm')
    world = World(robot, None, 'free1', seed=3)
    samples = list(world.run(4.0))
    median = []
    for earth in (world.plant.earth_field, (0.0, 0.0, 0.0)):
        preset = load_estimator_settings('hall_arm')
        told = preset.model_copy(
            update={'field': preset.field.model_copy(update={'earth': earth})}
        )
        estimates, truth = run(SlidingWindowFilter(robot, None, told), samples)
        distance = np.linalg.norm(errors(estimates, truth)[5:, 1:, :3], axis=-1)
        assert len(distance) > 40
        median.append(np.median(distance))
    assert median[0] < 2e-4
    assert median[1] > 10.0 * median[0]


def test_the_first_estimate_waits_for_what_tells_the_shape(prior_map):
    """Strain that arrives after the first ToF frames, as it may on a graph, is waited for."""
    robot = rod()
    samples = list(stream(Rod(robot, seed=2), 1.0))
    strain = [s for s in samples if isinstance(s, StrainSample)]
    others = [s for s in samples if not isinstance(s, StrainSample)]
    late = [s for s in others if s.stamp - EPOCH < 0.2e9] + strain
    late += [s for s in others if s.stamp - EPOCH >= 0.2e9]
    for order, first in ((samples, 0.0), (late, 0.1), (others, 0.4)):
        estimates, truth = run(SlidingWindowFilter(robot, prior_map, settings()), order)
        assert (estimates[0].stamp - EPOCH) * 1e-9 >= first
        assert np.max(np.abs(errors(estimates[:5], truth)[:, :, :3])) < 0.02


def test_a_window_restored_knows_what_it_knew(prior_map):
    """Shortened and put into another shape, then restored: body and covariance are as before."""
    filter_ = SlidingWindowFilter(rod(), prior_map, settings())
    run(filter_, stream(Rod(rod(), seed=5), 2.0))
    window = filter_.window
    time, rings = window.columns[-2].time, filter_.grid.ring_nodes
    body, covariance = window.body(time), window.motion_covariance(time, rings)
    kept = window.snapshot()
    window.keep_newest(2)
    window.place(window.columns[-1].predict(0.5))
    track(window)
    assert not np.allclose(window.motion_covariance(time, rings), covariance, rtol=0.1)
    window.restore(kept)
    track(window)
    np.testing.assert_allclose(window.body(time).T, body.T, atol=1e-4)
    np.testing.assert_allclose(
        np.trace(window.motion_covariance(time, rings), axis1=1, axis2=2),
        np.trace(covariance, axis1=1, axis2=2),
        rtol=0.02,
    )


def test_cycles_split_by_late_clocks_are_whole_again_after(prior_map):
    """The next outputs wait again for every sensor of their instant."""
    robot = rod()
    samples = [s for s in stream(Rod(robot), 2.0) if not isinstance(s, TruthSample)]
    half = len(robot.tof) // 2
    late = {sensor.name for sensor in robot.tof[half:]}
    filter_, heard, whole = SlidingWindowFilter(robot, prior_map, settings()), {}, []
    for sample in samples:
        time = (sample.stamp - EPOCH) * 1e-9
        if isinstance(sample, TofFrame):
            heard.setdefault(sample.stamp, set()).add(sample.sensor)
            if sample.sensor in late and 0.7 < time < 1.2:
                sample = replace(sample, stamp=sample.stamp + 50_000_000)
        estimate = filter_.process(sample)
        if estimate is not None:
            whole.append((time, len(heard.get(estimate.stamp, ())) == len(robot.tof)))
    assert all(is_whole for time, is_whole in whole if time < 0.7)
    assert not all(is_whole for time, is_whole in whole if 0.7 < time < 1.2)
    assert all(is_whole for time, is_whole in whole if time > 1.3)


def test_what_enters_a_window_goes_where_its_lateness_says():
    """What is 0.03 s late at 0.12 s belongs before the knot at 0.1 s, and at 0.02 s nowhere."""

    class Late(GyroFactor):
        def lateness(self, measurement):
            return 0.03

    robot = rod()
    grid = Grid(robot, 0.16)
    setup = Setup(robot, grid, settings())
    window = Window(grid, Priors(robot, grid, settings()), settings())
    window.start(column_at_rest(grid, np.eye(4), np.tile(np.eye(6)[0], (grid.nodes, 1)), 0.0))
    late, now = Late(setup), GyroFactor(setup)
    for time, sensor in ((0.12, 'r1_imu'), (0.02, 'r2_imu'), (0.12, 'nobody')):
        window.enter((late, now), time, ImuSample(EPOCH, sensor, np.ones(3), np.zeros(3)))
    assert [len(interval.rows(late)) for interval in window.intervals] == [1, 0]
    assert [len(interval.rows(now)) for interval in window.intervals] == [1, 1]
