"""The URDF of a robot description: a tree of the same frames as TF's, with the same transforms."""

from xml.etree import ElementTree

from continuum_loc.offline.urdf import urdf
from continuum_loc.robot import load_robot
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner


def joints(root):
    """(child -> (parent, type, (4, 4)))."""
    found = {}
    for joint in root.findall('joint'):
        origin = joint.find('origin')
        roll, pitch, yaw = map(float, origin.get('rpy').split())
        T = np.eye(4)
        # As the URDF manual has it: about fixed x, then y, then z.
        turns = (
            Rotation.from_rotvec(a * e).as_matrix()
            for a, e in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)
        )
        T[:3, :3] = np.linalg.multi_dot(list(turns))
        T[:3, 3] = list(map(float, origin.get('xyz').split()))
        found[joint.find('child').get('link')] = (
            joint.find('parent').get('link'),
            joint.get('type'),
            T,
        )
    return found


@pytest.mark.parametrize('name', ['engine', 'soft_arm', 'hall_arm', 'tendon_robot'])
def test_it_is_a_tree_of_rings_that_float_and_sensors_that_are_fixed(name):
    robot = load_robot(name)
    root = ElementTree.fromstring(urdf(robot))
    links = [link.get('name') for link in root.findall('link')]
    found = joints(root)
    assert links == ['base_link', *robot.ring_names, *(s.name for s in robot.sensors)]
    assert set(found) == set(links) - {'base_link'}  # one parent each, but for the root
    for ring in robot.rings:
        parent, kind, T = found[ring.name]
        # robot_state_publisher leaves floating joints to others: the estimator's /tf.
        assert (parent, kind) == ('base_link', 'floating') and T[0, 3] == pytest.approx(ring.s)
    for sensor in robot.sensors:
        parent, kind, T = found[sensor.name]
        assert (parent, kind) == (sensor.ring, 'fixed')
        np.testing.assert_allclose(T, sensor.mount.T_ring_sensor, atol=1e-8)


def test_a_ring_is_drawn_across_the_body():
    robot = load_robot('engine')
    root = ElementTree.fromstring(urdf(robot, 'arm_base'))
    ring = next(one for one in root.findall('link') if one.get('name') == robot.ring_names[0])
    cylinder = ring.find('visual/geometry/cylinder')
    assert float(cylinder.get('radius')) == pytest.approx(robot.radius)
    roll, pitch, yaw = map(float, ring.find('visual/origin').get('rpy').split())
    np.testing.assert_allclose([roll, pitch, yaw], [0.0, np.pi / 2, 0.0], atol=1e-8)
    assert root.find('link').get('name') == 'arm_base'


def test_the_command_writes_it_or_prints_it(tmp_path):
    from continuum_loc.cli import app

    done = CliRunner().invoke(app, ['robot', 'urdf', 'soft_arm', str(tmp_path / 'arm.urdf')])
    assert done.exit_code == 0, done.output
    assert (tmp_path / 'arm.urdf').read_text() == urdf(load_robot('soft_arm'))
    printed = CliRunner().invoke(app, ['robot', 'urdf', 'soft_arm'])
    assert printed.stdout == urdf(load_robot('soft_arm'))
