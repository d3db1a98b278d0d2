"""Raw fields of real drivers: the geometry of the sensor, and what a status means."""

from continuum_loc.errors import MessageError
from continuum_loc.robot import TofModel
from hypothesis import given, settings
from hypothesis import strategies as st
from msg_tools.convert import tof_frame, tof_message
from msg_tools.drivers import fbg_sample, ism330_sample, vl53l5cx_frame
from msg_tools.factory import bag_messages
import numpy as np
import pytest

VL53L5CX = TofModel(convention='perpendicular', flip_rows=True, flip_columns=True)


@given(distance=st.integers(100, 4000))
@settings(max_examples=20, deadline=None)
def test_a_wall_across_the_axis_is_flat(distance):
    """
    Perpendicular distances of one value are a plane.

    Every point has that x, and the ranges grow to the corners.
    """
    frame = vl53l5cx_frame(VL53L5CX, 'a', 1, [distance] * 64, [5] * 64)
    np.testing.assert_allclose(frame.points[:, 0], distance / 1000)
    np.testing.assert_allclose(frame.ranges, np.linalg.norm(frame.points, axis=1))
    assert frame.ranges.max() / frame.ranges.min() > 1.1
    # And the message is accepted as consistent.
    back = tof_frame(tof_message(bag_messages(), frame))
    np.testing.assert_allclose(back.ranges, frame.ranges, rtol=1e-6)


def test_the_lens_is_undone():
    """
    The first zone of the mounted sensor looks to +y, +z.

    The rows and columns of the frame would begin at -y, -z.
    """
    assert (vl53l5cx_frame(VL53L5CX, 'a', 1, [1000] * 64, [5] * 64).points[0, 1:] > 0).all()
    plain = TofModel(convention='perpendicular')
    assert (vl53l5cx_frame(plain, 'a', 1, [1000] * 64, [5] * 64).points[0, 1:] < 0).all()


def test_status_decides_what_a_distance_means():
    status = np.resize([5, 6, 9, 4, 10, 12, 13, 255], 64)
    distance = np.full(64, 800)
    distance[8] = 10  # closer than the sensor can see
    frame = vl53l5cx_frame(VL53L5CX, 'a', 1, distance, status, [7] * 64)
    np.testing.assert_array_equal(
        np.isfinite(frame.ranges), np.isin(status, (5, 6, 9)) & (distance > 100)
    )
    assert frame.ranges[8] == -np.inf and (frame.ranges[status == 255] == np.inf).all()
    assert np.isnan(frame.ranges[status == 4]).all()
    np.testing.assert_allclose(frame.sigma[np.isfinite(frame.ranges)], 0.007)
    none = vl53l5cx_frame(VL53L5CX, 'a', 1, distance, [5] * 64, nb_target_detected=[0] * 64)
    assert (none.ranges == np.inf).all()


def test_arrays_must_fit_the_grid():
    with pytest.raises(MessageError, match='distance_mm: 16 values; valid: 64'):
        vl53l5cx_frame(VL53L5CX, 'a', 1, [1] * 16, [5] * 64)


def test_ism330_at_its_data_sheet_sensitivities():
    sample = ism330_sample('imu', 1, [0, 0, 10_000], [0, 0, 8197], 17.5, 0.122)
    assert np.degrees(sample.angular_velocity[2]) == pytest.approx(175.0)
    assert sample.linear_acceleration[2] == pytest.approx(9.807, abs=0.01)


@given(theta=st.floats(-3.1, 3.1), kappa=st.floats(0.05, 20.0), common=st.floats(-1e-3, 1e-3))
@settings(max_examples=50, deadline=None)
def test_bending_is_found_whatever_temperature_and_tension(theta, kappa, common):
    """
    The curvature vector points to the inside of the bend.

    A core there is shortened by kappa times its distance.
    """
    azimuth, radius = np.array([10.0, 130.0, 250.0]), 35e-6
    strain = common - kappa * radius * np.cos(np.radians(azimuth) - theta)
    sample = fbg_sample(1, [0.1], [strain], azimuth, radius)
    assert sample.kappa[0] == pytest.approx(kappa, rel=1e-6)
    assert np.exp(1j * sample.theta[0]) == pytest.approx(np.exp(1j * theta), abs=1e-6)


def test_the_bending_plane_is_that_of_the_measurement():
    """
    Bent with theta = 0 the backbone curves towards +y.

    Strain (0, -sin theta, cos theta) kappa, a turn about +z.
    """
    from continuum_loc import lie

    sample = fbg_sample(1, [0.0], [[-1e-3, 0.5e-3, 0.5e-3]], [0.0, 120.0, 240.0], 1e-3)
    theta, kappa = sample.theta[0], sample.kappa[0]
    strain = np.array([1.0, 0.0, 0.0, 0.0, -kappa * np.sin(theta), kappa * np.cos(theta)])
    assert lie.exp(0.5 * strain)[1, 3] > 0.05
