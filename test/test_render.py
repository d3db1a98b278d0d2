"""
The ray-cast pictures show what geometry says.

A sphere's disc, its section, and the parts of a robot.
"""

from types import SimpleNamespace

from continuum_loc.robot import load_robot
from continuum_loc.simulator.render import (
    ADDED,
    BODY,
    Camera,
    MISSING,
    render,
    RING,
    robot_shapes,
    scene_shapes,
    Shape,
    SKY,
)
from continuum_loc.simulator.scenes import load_scene
import numpy as np
import pytest
from studies._paper_figures import by_depth, scene_picture

trimesh = pytest.importorskip('trimesh')
RED = (1.0, 0.0, 0.0)


def sphere(radius=0.5):
    mesh = trimesh.creation.icosphere(5, radius)
    return Shape(np.asarray(mesh.vertices), np.asarray(mesh.faces), RED)


def covered(image):
    return np.any(image != np.round(255 * np.array(SKY)), axis=-1)


def test_a_sphere_covers_the_disc_of_its_tangent_cone():
    camera = Camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), fov_deg=45.0, width=200, height=200)
    image = render([sphere()], camera)
    # Of half the picture's width.
    tangent = np.tan(np.arcsin(0.5 / 2.0)) / np.tan(np.radians(22.5))
    assert covered(image).mean() == pytest.approx(np.pi * tangent**2 / 4.0, rel=0.02)
    assert image[100, 100, 0] > 100 and np.all(image[100, 100, 1:] == 0)


def test_a_section_cuts_away_what_lies_before_it():
    whole = Camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=60, height=60)
    beyond = Camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), width=60, height=60, section=0.6)
    assert (
        covered(render([sphere()], whole)).any() and not covered(render([sphere()], beyond)).any()
    )


def test_a_robot_has_a_body_a_band_per_ring_and_a_box_per_sensor():
    robot = load_robot('engine')
    backbone = np.tile(np.eye(4), (31, 1, 1))
    backbone[:, 0, 3] = np.linspace(0.0, robot.length, 31)
    rings = np.tile(np.eye(4), (5, 1, 1))
    rings[:, 0, 3] = robot.ring_arclengths
    shapes = robot_shapes(robot, backbone, rings)
    assert [shape.colour for shape in shapes].count(BODY) == 1
    assert [shape.colour for shape in shapes].count(RING) == 5 and len(shapes) == 1 + 5 + 16
    body = trimesh.Trimesh(shapes[0].vertices, shapes[0].faces)
    assert body.is_watertight
    assert abs(body.volume) == pytest.approx(np.pi * robot.radius**2 * robot.length, rel=0.02)


def test_daylight_leaves_an_inner_corner_darker_than_the_open_floor():
    floor = Shape(
        np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        RED,
    )
    wall = Shape(
        np.array([[-9.0, 0, 0], [9, 0, 0], [9, 0, 9], [-9, 0, 9]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        RED,
    )
    camera = Camera((0.0, -1.0, 1.0), (0.0, -0.4, 0.0), fov_deg=50.0, width=40, height=40)
    even, shaded = (render([floor, wall], camera, rays)[..., 0].astype(float) for rays in (0, 64))
    darkening = (shaded / even)[:, 20]
    assert darkening[-1] > 0.98  # 60 cm from the wall: the whole sky within reach
    assert darkening.min() < 0.85  # at the foot of the wall: half of it


def test_changes_to_the_engine_stand_out():
    """Each change of S8 has its own shape, in the colour of what came or of what went."""
    scene = load_scene('S8')
    shapes = scene_shapes(scene)
    gone = [anomaly for anomaly in scene.anomalies if anomaly.kind == 'missing']
    assert [shape.colour for shape in shapes].count(MISSING) == len(gone)
    added = next(shape for shape in shapes if shape.colour == ADDED)
    places = added.vertices[np.unique(added.faces)]
    for anomaly in scene.anomalies:
        near = np.linalg.norm(places - anomaly.centre, axis=1).min() < anomaly.size
        assert near == (anomaly.kind == 'added'), anomaly.name


def test_what_was_found_is_red_over_the_map_and_nowhere_else():
    rng = np.random.default_rng(0)
    cloud = rng.uniform((-0.5, -0.4, 0.0), (0.5, 0.4, 0.6), (4000, 3))
    found = SimpleNamespace(points=cloud[cloud[:, 1] > 0.1][:50], confidence=1.0)
    unsure = SimpleNamespace(points=cloud[cloud[:, 1] > 0.1][50:], confidence=0.0)
    picture = scene_picture(load_scene('R0'), cloud, cloud, [found, unsure]).astype(int)
    red = (picture[..., 0] > 90) & (picture[..., 1:].max(axis=2) < 0.3 * picture[..., 0])
    height, width = (size // 2 for size in red.shape)
    assert red[height:, width:].sum() > 100
    red[height:, width:] = False
    assert not red.any()


def test_a_cloud_is_shaded_by_how_far_it_is():
    camera = Camera((0.0, -2.0, 0.0), (0.0, 0.0, 0.0))
    points = np.column_stack([np.zeros(80), np.linspace(0.0, 3.0, 80), np.zeros(80)])
    shades = np.array([shape.colour for shape in by_depth(points, camera)])
    assert (np.diff(shades[:, 1]) < 0.0).all()  # from bright to dark
    ends = [shape.vertices[:, 1].max() for shape in by_depth(points, camera)]
    assert (np.diff(ends) > 0.0).all()
