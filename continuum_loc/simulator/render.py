"""
Pictures of a robot in its scene, by ray casting on the processor: no graphics driver is needed.

    python -m continuum_loc.simulator.render docs/pictures

draws every bundled robot and scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import sys

from continuum_loc.extras import require
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.simulator.scene import Scene
from continuum_loc.simulator.scenes import load_scene
from continuum_loc.simulator.world import World
import numpy as np

BODY, RING, SENSOR = (0.93, 0.55, 0.20), (0.25, 0.27, 0.30), (0.98, 0.85, 0.15)
ADDED, MISSING = (0.85, 0.12, 0.16), (0.50, 0.20, 0.78)
SCENE, SKY = (0.66, 0.73, 0.80), (1.0, 1.0, 1.0)
PAINT = {
    'casing': (0.55, 0.60, 0.66),
    'hub': (0.40, 0.45, 0.52),
    'box': (0.86, 0.85, 0.82),
    'mustard_bottle': (0.93, 0.78, 0.12),
    'cup': (0.20, 0.48, 0.75),
    'cracker_box': (0.78, 0.20, 0.18),
    'wet_floor_sign': (0.97, 0.88, 0.20),
}
# Shadows of what is near only: inside, all is in the dark.
AMBIENT, SHADOW, SHADOW_LENGTH = (
    0.45,
    0.55,
    0.3,
)
# Rays per sample for `draw`; what is farther than this hides no sky [m].
DAYLIGHT, DAYLIGHT_REACH = (
    8,
    0.15,
)
SUPERSAMPLE = 2
SIDES = 48


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole at `eye` that looks at `target` (map, m), z up; it sees from y = `section` on."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov_deg: float = 45.0
    width: int = 960
    height: int = 640
    section: float = -np.inf

    def rays(self, supersample: int) -> np.ndarray:
        """(H, W, 3) unit directions."""
        forward = np.subtract(self.target, self.eye)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        height, width = supersample * self.height, supersample * self.width
        scale = np.tan(np.radians(self.fov_deg) / 2.0) / (width / 2.0)
        x = (np.arange(width) + 0.5 - width / 2.0) * scale
        y = (height / 2.0 - np.arange(height) - 0.5) * scale
        rays = forward + x[None, :, None] * right + y[:, None, None] * up
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def start(self, rays: np.ndarray) -> np.ndarray:
        """(..., 3) where each ray begins: the eye, or the section if that lies farther on."""
        eye = np.asarray(self.eye)
        if not eye[1] < self.section:
            return np.broadcast_to(eye, rays.shape)
        along = np.where(
            rays[..., 1] > 1e-6, (self.section - eye[1]) / np.maximum(rays[..., 1], 1e-6), 1e6
        )
        return eye + along[..., None] * rays


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A mesh of one colour: vertices (V, 3) m, faces (F, 3), rgb in [0, 1]."""

    vertices: np.ndarray
    faces: np.ndarray
    colour: tuple[float, float, float]


def render(shapes: list[Shape], camera: Camera, daylight: int = 0) -> np.ndarray:
    """
    (H, W, 3) uint8 image: one light from the camera's upper left, with shadows.

    daylight: rays per sample that ask how much of the sky within `DAYLIGHT_REACH` each surface
    sees, which shades corners; 0 leaves all surfaces in even light, and is quick.
    """
    o3d = require('open3d', 'simulate')

    caster = o3d.t.geometry.RaycastingScene()
    for shape in shapes:
        caster.add_triangles(
            o3d.core.Tensor(shape.vertices.astype(np.float32)),
            o3d.core.Tensor(shape.faces.astype(np.uint32)),
        )
    rays = camera.rays(SUPERSAMPLE)
    eye = camera.start(rays)
    hits = caster.cast_rays(
        o3d.core.Tensor(np.concatenate([eye, rays], axis=-1).astype(np.float32))
    )
    distance, normals = hits['t_hit'].numpy(), hits['primitive_normals'].numpy()
    hit = np.isfinite(distance)
    normals = normals * -np.sign(np.sum(normals * rays, axis=-1, keepdims=True))
    light = _light(camera)
    points = eye + np.where(hit, distance, 0.0)[..., None] * rays + 1e-4 * normals
    towards = np.concatenate([points, np.broadcast_to(light, points.shape)], axis=-1).astype(
        np.float32
    )
    shadowed = caster.test_occlusions(o3d.core.Tensor(towards), tfar=SHADOW_LENGTH).numpy()
    ambient = AMBIENT * (_daylight(caster, points, normals, daylight) if daylight else 1.0)
    lit = np.clip(normals @ light, 0.0, 1.0) * np.where(shadowed, SHADOW, 1.0)
    facing = -np.sum(normals * rays, axis=-1)  # a lamp at the camera
    brightness = ambient + (1.0 - AMBIENT) * (0.7 * lit + 0.4 * facing)
    palette = np.array([shape.colour for shape in shapes])
    colour = (
        palette[np.where(hit, hits['geometry_ids'].numpy(), 0).astype(int)] * brightness[..., None]
    )
    image = np.where(hit[..., None], np.minimum(colour, 1.0), SKY)
    blocks = image.reshape(camera.height, SUPERSAMPLE, camera.width, SUPERSAMPLE, 3)
    return (255.0 * blocks.mean(axis=(1, 3))).astype(np.uint8)


def robot_shapes(
    robot: RobotDescription, T_map_backbone: np.ndarray, T_map_ring: np.ndarray
) -> list[Shape]:
    """Draw the body along the backbone (B, 4, 4), rings (R, 4, 4) as dark bands, and sensors."""
    shapes = [_tube(T_map_backbone, robot.radius, BODY)]
    band = np.tile(np.eye(4), (2, 1, 1))
    band[:, 0, 3] = [-0.4 * robot.radius, 0.0]
    shapes += [_tube(T @ band, 1.08 * robot.radius, RING) for T in T_map_ring]
    for sensor in robot.tof + robot.hall:
        T = T_map_ring[robot.ring_names.index(sensor.ring)] @ sensor.mount.T_ring_sensor
        shapes.append(_box(T, 0.25 * robot.radius, SENSOR))
    return shapes


def scene_shapes(scene: Scene) -> list[Shape]:
    """Draw the scene in its parts' colours; what was added or is missing stands out."""
    added = {anomaly.name for anomaly in scene.anomalies if anomaly.kind == 'added'} - set(PAINT)
    colours = [ADDED if name in added else PAINT.get(name, SCENE) for name in scene.objects]
    palette = sorted(set(colours))
    shade = np.array([palette.index(colour) for colour in colours])[scene.face_object]
    gone = [Shape(a.vertices, a.faces, MISSING) for a in scene.anomalies if a.kind == 'missing']
    return [
        Shape(scene.vertices, scene.faces[shade == k], colour) for k, colour in enumerate(palette)
    ] + gone


def _daylight(caster, points: np.ndarray, normals: np.ndarray, rays: int) -> np.ndarray:
    """(H, W) share of the sky above each surface that nothing within `DAYLIGHT_REACH` hides."""
    o3d = require('open3d', 'simulate')

    rng, free = np.random.default_rng(0), np.zeros(points.shape[:2])
    for _ in range(rays):
        sphere = rng.standard_normal(points.shape).astype(np.float32)
        sphere /= np.linalg.norm(sphere, axis=-1, keepdims=True)
        up = normals + sphere  # directions crowd about the normal as their cosine
        up /= np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-6)
        ray = np.concatenate([points, up], axis=-1).astype(np.float32)
        free += ~caster.test_occlusions(o3d.core.Tensor(ray), tfar=DAYLIGHT_REACH).numpy()
    return free / rays


def _light(camera: Camera) -> np.ndarray:
    back = np.subtract(camera.eye, camera.target)
    left = np.cross(back, [0.0, 0.0, 1.0])
    light = back / np.linalg.norm(back) + 0.5 * left / np.linalg.norm(left) + [0.0, 0.0, 0.8]
    return light / np.linalg.norm(light)


def _tube(T_map_section: np.ndarray, radius: float, colour: tuple[float, float, float]) -> Shape:
    """Circles about the x axis of each section (K, 4, 4), joined, with both ends closed."""
    angle = np.arange(SIDES) * 2.0 * np.pi / SIDES
    circle = radius * np.stack([np.zeros(SIDES), np.cos(angle), np.sin(angle)], axis=-1)
    rims = T_map_section[:, None, :3, 3] + circle @ np.swapaxes(T_map_section[:, :3, :3], -1, -2)
    vertices = np.concatenate([rims.reshape(-1, 3), T_map_section[[0, -1], :3, 3]])
    k, i = np.meshgrid(np.arange(len(T_map_section) - 1), np.arange(SIDES), indexing='ij')
    a, b = (k * SIDES + i).ravel(), (k * SIDES + (i + 1) % SIDES).ravel()
    rim = np.arange(SIDES)
    last = (len(T_map_section) - 1) * SIDES
    ends = [
        np.stack(
            [np.full(SIDES, len(vertices) - 2 + end), rim + at, (rim + 1) % SIDES + at], axis=-1
        )
        for end, at in ((0, 0), (1, last))
    ]
    faces = np.concatenate(
        [np.stack([a, b, a + SIDES], -1), np.stack([b, b + SIDES, a + SIDES], -1), *ends]
    )
    return Shape(vertices, faces, colour)


def _box(T_map_box: np.ndarray, half: float, colour: tuple[float, float, float]) -> Shape:
    trimesh = require('trimesh', 'simulate')

    box = trimesh.creation.box((half, 2.0 * half, 2.0 * half), transform=T_map_box)
    return Shape(np.asarray(box.vertices), np.asarray(box.faces), colour)


# What to draw: robot, trajectory, moment [s], scene (None: the robot alone), camera.
_ENGINE = Camera((-0.3, -1.9, 1.35), (0.85, 0.0, 0.95), fov_deg=60.0, section=-0.12)
_BOX = Camera((0.38, -1.40, 0.80), (0.03, 0.0, 0.22), fov_deg=49.0, section=-0.345)
PICTURES = {
    'robot_engine': (
        'engine',
        't1',
        13.0,
        None,
        Camera((0.2, -2.2, 1.4), (0.8, 0.0, 0.95), fov_deg=40.0),
    ),
    'robot_soft_arm': (
        'soft_arm',
        'b5',
        9.0,
        None,
        Camera((-0.5, -1.0, 0.5), (0.05, 0.0, 0.38), fov_deg=40.0),
    ),
    'robot_hall_arm': (
        'hall_arm',
        'groove80',
        8.0,
        None,
        Camera((0.05, -0.25, 0.07), (0.045, 0.0, 0.028), 32.0),
    ),
    **{f'scene_S{k}': ('engine', 't1', 13.0, f'S{k}', _ENGINE) for k in range(10)},
    **{f'scene_R{k}': ('soft_arm', 'b5', 9.0, f'R{k}', _BOX) for k in range(5)},
}


def draw(name: str) -> np.ndarray:
    """(H, W, 3) uint8: the picture of `PICTURES` called `name`, simulated to its moment."""
    robot_name, trajectory, moment, scene_name, camera = PICTURES[name]
    robot = load_robot(robot_name)
    scene = load_scene(scene_name) if scene_name else None
    world = World(robot.model_copy(update={'tof': (), 'strain': None}), scene, trajectory)
    for _ in world.run(moment):
        pass
    backbone = world.full_state(np.linspace(0.0, robot.length, 201))
    shapes = robot_shapes(robot, backbone, world.full_state(robot.ring_arclengths))
    return render(shapes + (scene_shapes(scene) if scene else []), camera, DAYLIGHT)


def main() -> None:
    """Draw every picture into the folder named on the command line (default docs/pictures)."""
    from PIL import Image
    from rich.progress import track

    out = Path(sys.argv[1] if len(sys.argv) > 1 else 'docs/pictures')
    names = sys.argv[2:] or list(PICTURES)
    out.mkdir(parents=True, exist_ok=True)
    for name in track(names, description='drawing'):
        Image.fromarray(draw(name)).save(out / f'{name}.jpg', quality=88)


if __name__ == '__main__':
    main()
