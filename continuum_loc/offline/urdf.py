"""
A URDF of a robot description, so that robot_state_publisher and RViz show it.

Rings hang on floating joints, which robot_state_publisher leaves to whoever knows them: the
estimator, on /tf. Sensors are fixed to their rings.
"""

from __future__ import annotations

from collections.abc import Iterable
import warnings
from xml.etree import ElementTree

from continuum_loc.robot import RobotDescription
import numpy as np
from scipy.spatial.transform import Rotation

BASE_LINK = 'base_link'
DISC = 0.004  # m; how thick a ring is drawn
CHIP = 0.006  # m; how large a sensor is drawn
COLOURS = {
    'body': '0.25 0.28 0.32 1',
    'tof': '0.35 0.85 0.45 1',
    'imu': '0.95 0.75 0.20 1',
    'hall': '0.70 0.45 0.90 1',
    'trackers': '0.95 0.45 0.35 1',
}


def urdf(robot: RobotDescription, base_link: str = BASE_LINK) -> str:
    """Return the XML; lengths in metres, links named as the frames on TF without their prefix."""
    root = ElementTree.Element('robot', name=robot.name)
    for name, rgba in COLOURS.items():
        material = ElementTree.SubElement(root, 'material', name=name)
        ElementTree.SubElement(material, 'color', rgba=rgba)
    _link(root, base_link)
    for ring in robot.rings:
        disc = _link(root, ring.name)
        # A cylinder of URDF lies along z, the body along x.
        upright = np.eye(4)
        upright[:3, :3] = Rotation.from_euler('y', 90, degrees=True).as_matrix()
        shape = {'radius': _number(robot.radius), 'length': _number(DISC)}
        _visual(disc, 'cylinder', shape, 'body', upright)
        at_rest = np.eye(4)
        at_rest[0, 3] = ring.s
        _joint(root, 'floating', base_link, ring.name, at_rest)
    for kind in ('tof', 'imu', 'hall', 'trackers'):
        for sensor in getattr(robot, kind):
            chip = _link(root, sensor.name)
            _visual(chip, 'box', {'size': _numbers([CHIP / 3.0, CHIP, CHIP])}, kind, np.eye(4))
            _joint(root, 'fixed', sensor.ring, sensor.name, sensor.mount.T_ring_sensor)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding='unicode', xml_declaration=True) + '\n'


def _link(root: ElementTree.Element, name: str) -> ElementTree.Element:
    return ElementTree.SubElement(root, 'link', name=name)


def _joint(
    root: ElementTree.Element, kind: str, parent: str, child: str, T_parent_child: np.ndarray
) -> None:
    joint = ElementTree.SubElement(root, 'joint', name=f'{parent}_to_{child}', type=kind)
    ElementTree.SubElement(joint, 'parent', link=parent)
    ElementTree.SubElement(joint, 'child', link=child)
    _origin(joint, T_parent_child)


def _visual(
    link: ElementTree.Element, shape: str, size: dict[str, str], material: str, T: np.ndarray
) -> None:
    visual = ElementTree.SubElement(link, 'visual')
    _origin(visual, T)
    ElementTree.SubElement(ElementTree.SubElement(visual, 'geometry'), shape, size)
    ElementTree.SubElement(visual, 'material', name=material)


def _origin(parent: ElementTree.Element, T: np.ndarray) -> None:
    """Roll, pitch and yaw of URDF are turns about fixed axes, x first."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', UserWarning)  # at a pitch of 90 deg any split serves
        rpy = Rotation.from_matrix(T[:3, :3]).as_euler('xyz')
    ElementTree.SubElement(parent, 'origin', xyz=_numbers(T[:3, 3]), rpy=_numbers(rpy))


def _numbers(values: Iterable[float]) -> str:
    return ' '.join(_number(value) for value in values)


def _number(value: float) -> str:
    return f'{value:.9g}'
