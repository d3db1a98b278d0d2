"""What is drawn of the body, and each ring by itself: places worked out by hand."""

from types import SimpleNamespace

from continuum_loc.estimate import Estimate
from continuum_loc.nodes.support.body import (
    body_message,
    ellipsoid,
    ring_records,
    ring_topics,
    sight,
)
from continuum_loc.nodes.support.transforms import Frames
from continuum_loc.robot import load_robot
from msg_tools.factory import ros_messages
from msg_tools.topics import topic_spec
import numpy as np
import pytest
import rclpy  # noqa: F401  (without it there are no messages)
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker

STAMP = 5 * 10**9 + 7


@pytest.fixture
def robot():
    return load_robot('engine')


def straight(robot, **changed):
    """Estimate of a body along the map's y, known to 1, 2 and 3 mm along its own axes."""
    count = len(robot.ring_names) + 1
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_euler('z', 90, degrees=True).as_matrix()
    T[1:, 1, 3] = robot.ring_arclengths
    covariance = np.tile(np.diag([1e-6, 4e-6, 9e-6, 1e-4, 1e-4, 1e-4]), (count, 1, 1))
    given = {
        'stamp': STAMP,
        'T_map_ring': T,
        'covariance': covariance,
        'strain': np.zeros((count, 6)),
        'velocity': np.arange(6.0 * count).reshape(count, 6),
        'velocity_covariance': covariance,
        'backbone_s': np.linspace(0.0, robot.length, 30),
        'T_map_backbone': np.tile(T[0], (30, 1, 1)),
        'status': 'tracking',
        'consistency': 1.0,
    }
    return Estimate(**given | changed)


def markers_of(robot, estimate, prefix=''):
    message = body_message(ros_messages(), Frames(robot, prefix, map='site'), estimate)
    assert {m.header.frame_id for m in message.markers} == {'site'}
    return message.markers


def test_every_ring_has_its_pose_and_velocity_at_the_stamp_of_poses(robot):
    estimate = straight(robot)
    records = dict(ring_records(Frames(robot, 'left_'), estimate))
    assert tuple(sorted(records)) == tuple(sorted(ring_topics(robot)))
    make = ros_messages()
    for number, name in enumerate(('base', *robot.ring_names)):
        pose = records[f'ring_pose/{name}']
        assert pose.stamp == STAMP
        np.testing.assert_array_equal(pose.T_map_sensor, estimate.T_map_ring[number])
        message = topic_spec(f'ring_pose/{name}').encode(make, pose)
        # About the map's axes: the body's x, known to 1 mm, is the map's y.
        diagonal = np.diag(np.reshape(message.pose.covariance, (6, 6)))
        np.testing.assert_allclose(diagonal[:3], [4e-6, 1e-6, 9e-6], atol=1e-18)
        twist = records[f'ring_twist/{name}']
        spec = topic_spec(f'ring_twist/{name}')
        message = spec.encode(make, twist)
        assert message.header.frame_id == ('left_base_link' if name == 'base' else f'left_{name}')
        assert message.twist.twist.angular.z == 6.0 * number + 5.0
        back = spec.decode(message, None, 'here')
        np.testing.assert_array_equal(back.velocity, estimate.velocity[number])
        np.testing.assert_array_equal(back.covariance, estimate.velocity_covariance[number])


def test_an_ellipsoid_has_the_axes_in_which_the_ring_is_known(robot):
    """C = diag(1, 4, 9) mm^2 turned by R: sigmas of 1, 2, 3 mm along the columns of R."""
    R = Rotation.from_euler('xyz', [20, -40, 70], degrees=True).as_matrix()
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = R @ np.diag([1e-6, 4e-6, 9e-6]) @ R.T
    T_map_ring = np.eye(4)
    T_map_ring[:3, 3] = 1.0, 2.0, 3.0
    T, sigma = ellipsoid(T_map_ring, covariance)
    np.testing.assert_allclose(sigma, [0.001, 0.002, 0.003], rtol=1e-9)
    np.testing.assert_allclose(np.abs(T[:3, :3].T @ R), np.eye(3), atol=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_array_equal(T[:3, 3], [1.0, 2.0, 3.0])


def test_the_tube_is_as_thick_as_the_robot_and_its_ellipsoids_are_of_three_sigmas(robot):
    markers = markers_of(robot, straight(robot))
    (tube,) = [m for m in markers if m.ns == 'tube']
    assert tube.type == Marker.LINE_STRIP and tube.scale.x == pytest.approx(2.0 * robot.radius)
    assert len(tube.points) == 30
    spheres = [m for m in markers if m.ns == 'sigma']
    assert len(spheres) == len(robot.ring_names) + 1
    for sphere in spheres:  # diameters
        assert sphere.type == Marker.SPHERE
        scale = sorted((sphere.scale.x, sphere.scale.y, sphere.scale.z))
        np.testing.assert_allclose(scale, [0.006, 0.012, 0.018], rtol=1e-6)
    assert markers[0].action == Marker.DELETEALL  # what is no longer so goes


def test_a_sensor_looks_along_its_own_axis_over_its_field_of_view():
    sensor = SimpleNamespace(mount=SimpleNamespace(T_ring_sensor=np.eye(4)))
    robot = SimpleNamespace(tof_model=SimpleNamespace(fov_deg=90.0))  # as wide as it is deep
    ends = sight(robot, sensor, np.eye(4)).reshape(8, 2, 3)
    np.testing.assert_allclose(ends[:4, 0], 0.0)
    np.testing.assert_allclose(ends[:4, 1, 0], 0.1)
    np.testing.assert_allclose(np.abs(ends[:, 1, 1:]), 0.1)
    np.testing.assert_allclose(np.linalg.norm(ends[4:, 1] - ends[4:, 0], axis=1), 0.2)


def test_a_suspect_is_red_and_named_and_the_tube_has_the_colour_of_the_status(robot):
    bad = robot.tof[0].name
    fine = markers_of(robot, straight(robot))
    said = straight(robot, suspects={bad: 'late'}, doubts=('turns too fast',), status='doubtful')
    doubted = markers_of(robot, said)
    assert len([m for m in fine if m.ns == 'tof']) == 1 and not [
        m for m in fine if m.ns == 'label'
    ]
    sights = [m for m in doubted if m.ns == 'tof']
    assert [len(m.points) for m in sights] == [16 * (len(robot.tof) - 1), 16]
    red = sights[1].color
    assert red.r > 0.9 and red.g < 0.2 and red.b < 0.2
    assert {m.text for m in doubted if m.ns == 'label'} == {f'{bad}: late', 'turns too fast'}
    tubes = [next(m for m in markers if m.ns == 'tube').color for markers in (fine, doubted)]
    assert tubes[0] != tubes[1]
    assert len({(m.ns, m.id) for m in doubted}) == len(doubted)
