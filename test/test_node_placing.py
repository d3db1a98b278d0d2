"""Where somebody says that the base is: in the map, in another frame, and on RViz's plane."""

from continuum_loc import lie
from continuum_loc.errors import FrameError
from continuum_loc.measurements import TrackedPose
from continuum_loc.nodes.support.frames import FrameTree
from continuum_loc.nodes.support.placing import is_planar, placed_base, raised, with_base
from continuum_loc.robot import load_robot
from msg_tools.convert import tracker_message
from msg_tools.factory import ros_messages
import numpy as np
import pytest
import rclpy  # noqa: F401  (without it there are no messages)
from scipy.spatial.transform import Rotation

# As RViz's tool "2D Pose Estimate" sends it.
OF_RVIZ = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.06853891909122467])


def message(T, covariance, frame='map'):
    made = tracker_message(ros_messages(), TrackedPose(7, 'base', T, covariance))
    made.header.frame_id = frame
    return made


def level(x, y, yaw):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('z', yaw).as_matrix()
    T[:2, 3] = x, y
    return T


def test_the_tool_of_rviz_is_told_from_a_pose_with_six_dimensions():
    assert is_planar(message(level(1.0, 2.0, 0.5), OF_RVIZ))
    assert not is_planar(message(level(1.0, 2.0, 0.5), np.eye(6)))  # its height is known to 1 m
    assert not is_planar(message(level(1.0, 2.0, 0.5), np.zeros((6, 6))))  # nothing is said of it
    higher = level(1.0, 2.0, 0.5)
    higher[2, 3] = 0.1
    assert not is_planar(message(higher, OF_RVIZ))


def test_a_planar_pose_keeps_the_height_and_the_tilt_of_the_description():
    robot = load_robot('engine')
    base = robot.base.model_dump() | {'xyz': (0.3, 0.2, 0.9), 'rpy_deg': (180.0, 20.0, 70.0)}
    robot = type(robot).model_validate(robot.model_dump() | {'base': base})
    T = raised(robot, level(1.0, 2.0, np.radians(-30.0)))
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, 0.9])
    rpy = Rotation.from_matrix(T[:3, :3]).as_euler('xyz', degrees=True)
    np.testing.assert_allclose(np.cos(np.radians(rpy - [180.0, 20.0, -30.0])), 1.0)


def test_a_pose_in_another_frame_goes_through_the_tree_and_its_covariance_turns_with_it():
    """The cart stands at (1, 0, 0) and looks along the map's y; the base is 2 m before it."""
    tree = FrameTree()
    tree.add('site', 'cart', level(1.0, 0.0, np.pi / 2), None)
    T_cart_base = level(2.0, 0.0, 0.0)
    covariance = np.diag([1e-2, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])  # along the cart's x known least
    pose = placed_base(message(T_cart_base, covariance, 'cart'), 'site', tree)
    np.testing.assert_allclose(pose.T_map_sensor[:3, 3], [1.0, 2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pose.covariance, covariance, atol=1e-15)  # in the body's axes
    for empty in ('', 'site', '/site'):
        there = placed_base(message(T_cart_base, covariance, empty), 'site', tree)
        np.testing.assert_allclose(there.T_map_sensor, T_cart_base, atol=1e-12)
    with pytest.raises(FrameError, match="no way from frame 'elsewhere' to 'site'"):
        placed_base(message(T_cart_base, covariance, 'elsewhere'), 'site', tree)


def test_a_base_that_is_moved_stands_there_at_its_present_insertion():
    robot = load_robot('engine')
    T = lie.exp(np.array([0.5, -0.2, 0.1, 0.3, -0.4, 1.0]))
    moved = with_base(robot, T, np.diag([4e-6] * 3 + [1e-4] * 3), insertion=0.25)
    inserted = np.eye(4)
    inserted[0, 3] = 0.25
    np.testing.assert_allclose(moved.base.T_map_base @ inserted, T, atol=1e-12)
    assert moved.base.sigma_position == pytest.approx(2e-3)
    kept = with_base(robot, T, np.zeros((6, 6)), 0.0)
    assert kept.base.sigma_position == robot.base.sigma_position
