"""
Attitude from IMU samples.

Known tilts, gravity's silence on yaw, the gate, and what the printed form gets wrong.
"""

from continuum_loc import lie
from continuum_loc.measurements import nanoseconds
from continuum_loc.shape.attitude import AttitudeSettings, GRAVITY, GravityFilter, level
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from studies.support.euler_filter import euler_rates, EulerFilter

UP = np.array([0.0, 0.0, 1.0])
DT = nanoseconds(0.01)
rotation_vectors = st.tuples(*[st.floats(-1.7, 1.7)] * 3).map(np.array)


def resting(R_map_imu):
    return GRAVITY * R_map_imu.T @ UP


def started(R, gyro_sigma=0.00087, accel_sigma=0.04, bias=(0.0, 0.0, 0.0), **settings):
    attitude = GravityFilter(AttitudeSettings(**settings), gyro_sigma, accel_sigma)
    attitude.start(0, R, np.array(bias))
    return attitude


def yaw_between(R_a, R_b):
    """Turn about the map's z from a to b, for rotations that differ by little tilt."""
    return lie.so3_log(R_b @ R_a.T)[2]


@given(rotation_vectors)
@settings(max_examples=12, deadline=None)
def test_gravity_levels_and_never_yaws(vector):
    """
    From a wrong tilt, corrections bring 'up' onto the measured up.

    Along the shortest way: no turn about z.
    """
    true = lie.so3_exp(vector)
    wrong = true @ lie.so3_exp(np.array([0.2, -0.1, 0.15]))
    attitude = started(wrong)
    previous = wrong.copy()
    for k in range(1, 1400):
        R = attitude.update(k * DT, np.zeros(3), resting(true)).copy()
        assert abs(lie.so3_log(R @ previous.T)[2]) < 1e-12, (
            'a correction turned about the vertical'
        )
        previous = R
    np.testing.assert_allclose(R.T @ UP, true.T @ UP, atol=1e-6)


@given(rotation_vectors, rotation_vectors)
@settings(max_examples=40, deadline=None)
def test_level_is_the_least_turn_onto_gravity(prior, vector):
    prior, true = lie.so3_exp(prior), lie.so3_exp(vector)
    if (prior.T @ UP) @ (true.T @ UP) < -0.99:
        return  # opposite directions have no least turn
    found = level(prior, resting(true))
    np.testing.assert_allclose(found.T @ UP, true.T @ UP, atol=1e-12)
    tilt = np.degrees(np.arccos(np.clip((prior.T @ UP) @ (true.T @ UP), -1.0, 1.0)))
    assert lie.rotation_error_deg(prior, found) == pytest.approx(tilt, abs=1e-5)


def test_gyro_alone_integrates_a_turn_to_second_order():
    """
    A smooth turn of 129 degrees about one axis, with the gate shut.

    It goes past 90 degrees of pitch.
    """

    def error(steps):
        attitude = started(np.eye(3), gate=1e-9)
        times = np.linspace(0.0, 1.0, steps + 1)
        rate = np.radians(129) * 30 * times**2 * (1 - times) ** 2
        for t, w in zip(times[1:], rate[1:], strict=True):
            attitude.update(nanoseconds(t), np.array([0.0, w, 0.0]), np.zeros(3))
        return lie.rotation_error_deg(
            attitude.R_map_imu, lie.so3_exp(np.array([0.0, np.radians(129), 0.0]))
        )

    assert error(100) < 1e-3
    assert error(50) < 1e-2


def test_moving_acceleration_is_gated():
    attitude = started(np.eye(3))
    for k in range(1, 100):
        attitude.update(k * DT, np.zeros(3), np.array([5.0, 0.0, GRAVITY]))
    np.testing.assert_allclose(attitude.R_map_imu, np.eye(3), atol=1e-15)
    assert attitude.gated == 99
    attitude.update(100 * DT, np.zeros(3), np.array([np.nan, 0.0, GRAVITY]))
    assert np.isfinite(attitude.R_map_imu).all() and attitude.gated == 100


def test_tilt_stays_and_yaw_drifts_by_the_residual_bias():
    """
    A bias of b about the vertical gives yaw b t and its covariance says so.

    A level bias gives tilt b tau.
    """
    bias = 2e-3
    attitude = started(np.eye(3), time_constant=1.0, bias_sigma=bias)
    for k in range(1, 2001):
        attitude.update(k * DT, np.array([bias, 0.0, bias]), resting(np.eye(3)))
    tilt = np.arccos(attitude.R_map_imu[2, 2])
    assert tilt == pytest.approx(bias * 1.0, rel=0.02)
    assert yaw_between(np.eye(3), attitude.R_map_imu) == pytest.approx(bias * 20.0, rel=0.02)
    assert attitude.yaw_sigma == pytest.approx(bias * 20.0, rel=0.01)
    assert attitude.tilt_sigma < 0.1 * attitude.yaw_sigma


def test_stated_covariance_is_the_spread_over_many_runs():
    """
    400 filters over 10 s: a sample sigma is good to 3.5 %, so 20 % is beyond 5 sigma.

    The bias is known here.
    """
    rng = np.random.default_rng(1)
    gyro_sigma, accel_sigma, found = 0.002, 0.05, []
    for _ in range(400):
        attitude = started(np.eye(3), gyro_sigma, accel_sigma, bias_sigma=0.0)
        for k in range(1, 501):
            attitude.update(
                2 * k * DT,
                gyro_sigma * rng.standard_normal(3),
                resting(np.eye(3)) + accel_sigma * rng.standard_normal(3),
            )
        found.append(lie.so3_log(attitude.R_map_imu))
    spread = np.std(found, axis=0)
    np.testing.assert_allclose(spread[:2] / attitude.tilt_sigma, 1.0, atol=0.2)
    np.testing.assert_allclose(spread[2] / attitude.yaw_sigma, 1.0, atol=0.2)


def test_rotation_between_samples_follows_the_last_rate():
    attitude = started(np.eye(3), gate=1e-9)
    attitude.update(DT, np.array([0.0, 0.0, 1.0]), np.zeros(3))
    ahead = attitude.rotation_at(3 * DT)
    assert lie.so3_log(attitude.R_map_imu.T @ ahead) == pytest.approx([0.0, 0.0, 0.02])
    assert attitude.stamp == DT


# The paper's form


@pytest.mark.parametrize(
    ('axis', 'sign'), [('roll', 1), ('roll', -1), ('pitch', 1), ('pitch', -1)]
)
def test_mended_euler_form_reads_a_known_tilt(axis, sign):
    """Its convention against a tilt that is known: 50 degrees about x or y."""
    vector = np.radians(50.0 * sign) * np.array([axis == 'roll', axis == 'pitch', 0.0])
    true = lie.so3_exp(vector)
    euler = EulerFilter()
    euler.update(0, np.zeros(3), resting(true))
    np.testing.assert_allclose(euler.R_map_imu, true, atol=1e-12)


def test_printed_forms_read_it_wrong():
    pitched, rolled = (lie.so3_exp(v) for v in np.radians([[0.0, 50.0, 0.0], [107.0, 0.0, 0.0]]))

    def read(true, **printed):
        euler = EulerFilter(**printed)
        return euler.update(0, np.zeros(3), resting(true))

    assert lie.rotation_error_deg(read(pitched, pitch_as_printed=True), pitched) == pytest.approx(
        100.0
    )
    assert lie.rotation_error_deg(read(rolled, quadrant_as_printed=True), rolled) == pytest.approx(
        180.0
    )
    assert lie.rotation_error_deg(read(pitched, swap_as_printed=True), pitched) > 60.0


def test_printed_yaw_decays_to_nothing():
    true = Rotation.from_euler('z', 40, degrees=True).as_matrix()
    for printed, left in ((True, 0.0), (False, np.radians(40.0))):
        euler = EulerFilter(yaw_as_printed=printed)
        euler.update(0, np.zeros(3), resting(true))
        euler.angles[2] = np.radians(40.0)
        for k in range(1, 100):
            euler.update(k * DT, np.zeros(3), resting(true))
        assert euler.angles[2] == pytest.approx(left, abs=1e-12)


@given(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4), st.floats(-3.0, 3.0), rotation_vectors)
@settings(max_examples=50, deadline=None)
def test_euler_rates_are_the_derivative_of_the_angles(roll, pitch, yaw, rate):
    """Eq. 4 against the angles of R exp(rate h), away from its singularity."""
    angles, h = np.array([roll, pitch, yaw]), 1e-6
    R = Rotation.from_euler('ZYX', angles[::-1]).as_matrix()

    def after(step):
        return Rotation.from_matrix(R @ lie.so3_exp(rate * step)).as_euler('ZYX')[::-1]

    difference = (after(h) - after(-h) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(euler_rates(angles, rate), difference / (2 * h), atol=1e-4)


def test_euler_rates_grow_without_bound_at_90_degrees_of_pitch():
    rate = np.array([0.0, 0.0, 1.0])
    near, nearer = (
        abs(euler_rates(np.array([0.0, np.radians(90 - d), 0.0]), rate)[2]) for d in (1.0, 0.01)
    )
    assert nearer / near == pytest.approx(100.0, rel=1e-2)
