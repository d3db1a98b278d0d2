"""What contradicts the description is named, with its likely cause, and nobody else is blamed."""

from dataclasses import replace

from continuum_loc import lie
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.readings import curvature_cause, range_cause, travel_cause
from continuum_loc.estimator.turning import Ledger, Turn
from continuum_loc.measurements import (
    ImuSample,
    StrainSample,
    TOF_NO_TARGET,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
import numpy as np
import pytest
from worlds import EPOCH, Rod, rod, room_map, stream

SIGMA = 0.01  # rad/s of a gyro, 1/m of a strain sensor
SETTINGS = {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2}


def motion(seed=0, count=200):
    """Draw a smooth angular velocity (K, 3) of some tenths of a radian per second."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0, count)[:, None]
    return 0.4 * np.sin(rng.uniform(2, 5, 3) * t + rng.uniform(0, 6, 3))


def heard(change, seed=0, body_sigma=0.005, bias=0.0, mounted=1.0, rates=None):
    """
    Make the ledger of a gyro that reads `change` of a body's turns, over 2 s in tenths.

    body_sigma: with which the body's own mean rates are known [rad/s].
    """
    rng, ledger = np.random.default_rng(seed), Ledger(0.02, SIGMA)
    for rate in motion(seed)[5::10] if rates is None else rates:
        known = rate + body_sigma * rng.normal(size=3)
        read = change(np.dot(mounted, rate) + bias + SIGMA / np.sqrt(10) * rng.normal(size=3))
        ledger.add(Turn(known, body_sigma**2 * np.eye(3)), read, 10, 1.0)
    return ledger


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda w: w * 57.29578, 'too fast: degrees'),
        (lambda w: w / 57.29578, 'too slowly: converted to radians twice'),
        (lambda w: w * [1, 1, -1], 'sign of axis z'),
        (lambda w: w * [-1, 1, 1], 'sign of axis x'),
        (lambda w: w[[0, 2, 1]], 'axes swapped? (x, z, y)'),
        (lambda w: w[[1, 2, 0]], 'axes swapped? (z, x, y)'),
    ],
)
def test_a_gyro_that_reads_otherwise_than_the_body_turns_is_told_why(change, said):
    assert said in heard(change).cause()


@pytest.mark.parametrize('seed', range(20))
def test_a_healthy_gyro_is_told_nothing(seed):
    """A bias of 0.015 rad/s, axes 2 degrees and a scale 2 % off are what healthy ones have."""
    rng = np.random.default_rng(seed)
    mounted = 1.02 * lie.so3_exp(np.radians(2.0) * rng.normal(size=3))
    assert heard(lambda w: w, seed, bias=0.015, mounted=mounted).cause() == ''


def test_a_gyro_that_no_cause_explains_is_left_to_the_others():
    """A wrong body turns otherwise than its gyro in no way that a unit or an axis makes."""
    assert heard(lambda w: np.array([2.0, 0.3, 0.5]) * w).cause() == ''


def test_a_body_that_rattles_or_rests_tells_nothing_of_its_gyro():
    """
    What shakes faster than the knots follow is no unit: no cause explains any of it.

    Beside a body at rest, known to 0.02 rad/s, a gyro that says nothing is right and not one that
    reads too little.
    """
    rng = np.random.default_rng(2)
    assert heard(lambda w: w + 3.0 * rng.normal(size=3)).cause() == ''
    rest = np.zeros((60, 3))
    assert heard(lambda w: w, 3, body_sigma=0.02, rates=rest).cause() == ''


def test_what_a_ledger_has_forgotten_it_does_not_tell():
    """A gyro that is mended after 2 s is believed again once its past counts little."""
    ledger = heard(lambda w: w * [1, 1, -1])
    assert 'sign of axis z' in ledger.cause()
    rng = np.random.default_rng(5)
    for rate in np.tile(motion(1)[5::10], (6, 1)):
        read = rate + SIGMA / np.sqrt(10) * rng.normal(size=3)
        ledger.add(Turn(rate, 2.5e-5 * np.eye(3)), read, 10, 0.9)
    assert ledger.cause() == ''


def followed(change, seconds=3.0, seed=3, prior=True, description=None, **changed):
    """Estimates of a moving rod whose measurements are `change`d."""
    robot = description or rod()
    settings = parse_settings(EstimatorSettings, SETTINGS | changed)
    estimator = SlidingWindowFilter(robot, room_map() if prior else None, settings)
    made = []
    for sample in stream(Rod(robot, seed=seed), seconds):
        if not isinstance(sample, TruthSample):
            made.append(estimator.process(change(sample)))
    return [estimate for estimate in made if estimate is not None]


def of_gyro(name, change):
    def altered(sample):
        if isinstance(sample, ImuSample) and sample.sensor == name:
            return replace(sample, angular_velocity=change(sample.angular_velocity))
        return sample

    return altered


@pytest.mark.parametrize('seed', range(3))
def test_nobody_is_blamed_where_all_is_as_described(seed):
    made = followed(lambda sample: sample, seed=seed)
    assert all(not estimate.suspects and not estimate.doubts for estimate in made)
    assert made[-1].status == 'tracking'


def test_a_gyro_in_degrees_is_named_with_its_unit_and_alone():
    made = followed(of_gyro('r1_imu', lambda w: w * 57.29578))
    assert 'degrees' in made[-1].suspects['r1_imu']
    assert set().union(*(estimate.suspects for estimate in made)) == {'r1_imu'}


@pytest.mark.parametrize(
    ('change', 'said'),
    [
        (lambda t, k: (t, k / 1000), '1/mm'),
        (lambda t, k: (t, 1000 * k), '1000 times too large'),
        (lambda t, k: (np.degrees(t), k), 'angle in degrees'),
        (lambda t, k: (-t, k), 'angle of the other sign'),
        (lambda t, k: (t, -k), 'curvature of the other sign'),
        (lambda t, k: (t - np.pi / 2, k), '90 degrees too small'),
    ],
)
def test_strain_in_another_unit_or_sign_is_told(change, said):
    def altered(sample):
        if not isinstance(sample, StrainSample):
            return sample
        theta, kappa = change(sample.theta, sample.kappa)
        return replace(sample, theta=theta, kappa=kappa)

    made = followed(altered)
    assert said in made[-1].suspects['strain']


def test_a_filter_without_gyros_asks_nothing_of_them():
    """The gyros are looked at one by one from 1 s on, and these do not take part."""
    made = followed(of_gyro('r1_imu', lambda w: w * 57.29578), 2.0, gyro={'enabled': False})
    assert made[-1].status == 'tracking'
    assert all('r1_imu' not in estimate.suspects for estimate in made)


def test_without_a_usable_zone_or_without_a_map_the_estimate_is_doubtful():
    def blind(sample):
        if not isinstance(sample, TofFrame):
            return sample
        return replace(sample, status=np.full(len(sample.status), TOF_NO_TARGET, np.uint8))

    last = followed(blind, 2.0)[-1]
    assert last.status == 'doubtful' and any('no usable zone' in why for why in last.doubts)
    last = followed(lambda sample: sample, 2.0, prior=False)[-1]
    assert last.status == 'doubtful' and '7 ToF sensors are not used' in last.doubts[0]


@pytest.mark.parametrize('shift', [(0.3, 0.0, 0.0), (1.0, 1.0, 0.0)])
def test_trackers_that_contradict_the_base_are_not_tracking(shift):
    """Two trackers see a rod whose base is elsewhere: the loss takes them for outliers."""
    data = rod(tof=False, strain=False).model_dump()
    data['imu'] = []
    data['trackers'] = [{'name': f't{r}', 'ring': f'r{r}'} for r in (1, 2)]
    robot = parse_settings(RobotDescription, data)
    estimator = SlidingWindowFilter(robot, None, parse_settings(EstimatorSettings, SETTINGS))
    truth, T_shift = Rod(robot, seed=1), np.eye(4)
    T_shift[:3, 3] = shift
    made = []
    for k in range(120):
        poses = T_shift @ truth.rings(k / 40.0)
        for ring in (1, 2):
            pose = TrackedPose(EPOCH + k * 25_000_000, f't{ring}', poses[ring])
            made.append(estimator.process(pose))
    last = [estimate for estimate in made if estimate is not None][-1]
    assert last.status == 'doubtful' and last.doubts


def test_an_encoder_beyond_its_range_is_told_with_the_likely_unit():
    limits = (0.0, 0.6)
    assert travel_cause(0.61, limits) == '' == travel_cause(-0.01, limits)
    assert travel_cause(250.0, limits).endswith('millimetres?')
    assert travel_cause(25.0, limits).endswith('centimetres?')
    assert travel_cause(1.3, limits) == 'reads 1.3 m, beyond its range of 0 to 0.6 m'
    assert travel_cause(-5e4, limits).endswith('0.6 m')


def test_curvature_that_no_body_has_is_told_from_the_reading_alone():
    """A body of 2 cm bends about no point within itself: 50 1/m; noise of 0.01 1/m is not 10."""
    rng = np.random.default_rng(0)
    bent = np.linspace(0.1, 0.9, 20) + SIGMA * rng.normal(size=(8, 20))
    straight = SIGMA * rng.normal(size=(8, 20))
    assert curvature_cause(bent, SIGMA, 0.02) == '' == curvature_cause(straight, SIGMA, 0.02)
    assert '1000 times' in curvature_cause(1e3 * bent[:1], SIGMA, 0.02)
    assert '1000 times' in curvature_cause(1e3 * straight, SIGMA, 0.02)
    assert curvature_cause(1e3 * straight[:1], SIGMA, 0.02) == ''  # one sample has no noise


def test_ranges_in_millimetres_are_told():
    ranges = np.append(np.linspace(0.3, 2.0, 60), [np.inf] * 4)
    assert range_cause(ranges, 4.0) == ''
    assert range_cause(1e3 * ranges, 4.0).endswith('reach: millimetres?')
    assert range_cause(np.full(64, np.inf), 4.0) == ''
