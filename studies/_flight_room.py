"""
Simulated flights of a small drone with one VL53L5CX, about a hall with furniture.

A flight begins on the ground, where the public ones read 10 to 40 mm in all zones: the sensor
stands before a plate then. In the air it looks ahead, while the drone goes towards a thing, turns
before it and comes back.
"""

from __future__ import annotations

from continuum_loc.measurements import nanoseconds, seconds, TofFrame
from continuum_loc.robot import TofModel
from continuum_loc.simulator.raycast import RayCaster
from continuum_loc.simulator.readout import Readout, ReadoutSettings
from continuum_loc.simulator.scene import Scene
from continuum_loc.simulator.tof import TofSensorModel
from continuum_loc.simulator.vl53l5cx import Vl53l5cxSettings
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation
from studies._flight_statistics import Flight, SIDE
import trimesh

RATE = 15.0
HALL = ((10.0, 10.0, 2.8), (16.0, 14.0, 4.5))  # m, least and greatest
ON_GROUND = 0.17  # of a flight; the median over the public ones
PLATE = 0.024  # m before the sensor on the ground
NAME = 'front'


def simulated_flight(
    seed: int, duration: float = 25.0, settings: Vl53l5cxSettings | None = None
) -> Flight:
    """Fly for `duration` s about a hall, with a sensor, both drawn by `seed`."""
    rng = np.random.default_rng([seed, 53])
    model = TofModel(convention='perpendicular', rate=RATE)
    scene, targets = hall(rng)
    sensor = TofSensorModel(model, RayCaster(scene), 'vl53l5cx', rng, settings)
    readout = Readout(ReadoutSettings(held=float(rng.uniform(0.01, 0.09))), rng)
    times = np.arange(int(duration * RATE)) / RATE
    none = np.full((SIDE * SIDE, 3), np.nan)
    come: list[TofFrame] = []
    for time, T in zip(times, path(rng, times, targets), strict=True):
        read = sensor.read(T[None], [NAME])
        # What travels is the distance in the registers, not the range along the ray.
        frame = TofFrame(nanoseconds(time), NAME, none, read.raw[0], read.sigma[0], read.status[0])
        come += readout.take(frame)
    grid = (-1, SIDE, SIDE)
    return Flight(
        f'simulated {seed}',
        np.array([int(1e3 * seconds(frame.stamp)) for frame in come]),
        np.array([np.round(1e3 * frame.ranges) for frame in come]).astype(int).reshape(grid),
        np.array([frame.status for frame in come]).reshape(grid),
    )


def hall(rng: np.random.Generator) -> tuple[Scene, np.ndarray]:
    """Draw a hall with panels, chairs, boxes and a person, and where things to fly to stand."""
    size = rng.uniform(*HALL)
    room = trimesh.creation.box(size).apply_translation((0.0, 0.0, size[2] / 2.0))
    room.invert()
    meshes, reflectance = [room], [rng.uniform(0.5, 0.9)]
    # Smooth floors throw light on, away from the sensor.
    floor = trimesh.creation.box((*size[:2], 0.01)).apply_translation((0.0, 0.0, 0.005))
    meshes.append(floor)
    reflectance.append(rng.uniform(0.05, 0.2))
    places = _places(rng, size[:2], round(size[0] * size[1] / 16.0))
    kinds = (
        *3 * (_panel,),
        _person,
        *3 * (_panel,),
        _heap,
        *2 * (_panel,),
        _boxes,
        _panel,
        _chair,
    )
    first = int(rng.integers(len(kinds)))
    for number, place in enumerate(places):
        make = kinds[(first + number) % len(kinds)]
        for mesh in make(rng):
            turn = trimesh.transformations.rotation_matrix(rng.uniform(-0.3, 0.3), (0, 0, 1))
            meshes.append(mesh.apply_transform(turn).apply_translation((*place, 0.0)))
            reflectance.append(rng.uniform(0.3, 0.9))
    start = trimesh.creation.box((0.01, 0.3, 0.3)).apply_translation((PLATE + 0.005, 0.0, -1.0))
    meshes.append(start)
    reflectance.append(0.5)
    whole = trimesh.util.concatenate(meshes)
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    return Scene(
        'hall',
        np.array(whole.vertices, float),
        np.array(whole.faces, np.int32),
        owner.astype(np.int32),
        tuple(f'thing{number}' for number in range(len(meshes))),
        np.array(reflectance)[owner],
        (),
    ), places


def _places(rng: np.random.Generator, size: np.ndarray, count: int) -> np.ndarray:
    """(count, 2) places [m] that leave each other 2.4 m, and the hall's middle free."""
    corner = size / 2.0 - 0.5
    places: list[np.ndarray] = []
    while len(places) < count:
        place = rng.uniform(-corner, corner)
        if np.hypot(*place) > 1.5 and all(np.hypot(*(place - p)) > 2.4 for p in places):
            places.append(place)
    return np.array(places)


def _panel(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    width, height = rng.uniform(1.0, 2.4), rng.uniform(1.2, 2.2)
    turn = trimesh.transformations.rotation_matrix(rng.uniform(0.0, np.pi), (0, 0, 1))
    panel = trimesh.creation.box((0.02, width, height)).apply_translation((0, 0, height / 2.0))
    return [panel.apply_transform(turn)]


def _chair(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    corners = [(x, y) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    legs = [
        trimesh.creation.box((0.03, 0.03, 0.45)).apply_translation((x, y, 0.225))
        for x, y in corners
    ]
    seat = trimesh.creation.box((0.44, 0.44, 0.04)).apply_translation((0.0, 0.0, 0.47))
    back = trimesh.creation.box((0.03, 0.44, 0.45)).apply_translation((0.2, 0.0, 0.72))
    turn = trimesh.transformations.rotation_matrix(rng.uniform(0.0, 2.0 * np.pi), (0, 0, 1))
    return [trimesh.util.concatenate([*legs, seat, back]).apply_transform(turn)]


def _boxes(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    made, height = [], 0.0
    for _ in range(3):
        size = rng.uniform((0.25, 0.25, 0.2), (0.6, 0.6, 0.5))
        made.append(trimesh.creation.box(size).apply_translation((0, 0, height + size[2] / 2.0)))
        height += size[2]
    return made


def _heap(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Things without edges, a metre high."""
    made = []
    for _ in range(10):
        ball = trimesh.creation.icosphere(2, rng.uniform(0.25, 0.4))
        made.append(ball.apply_translation(rng.uniform((-0.3, -0.3, 0.1), (0.3, 0.3, 1.1))))
    return made


def _person(rng: np.random.Generator) -> list[trimesh.Trimesh]:
    height = rng.uniform(1.6, 1.85)
    legs = [
        trimesh.creation.cylinder(0.08, 0.85).apply_translation((0.0, y, 0.425))
        for y in (-0.11, 0.11)
    ]
    body = trimesh.creation.cylinder(0.19, 0.65).apply_translation((0.0, 0.0, 1.15))
    head = trimesh.creation.icosphere(2, 0.11).apply_translation((0.0, 0.0, height - 0.11))
    return [*legs, body, head]


def path(rng: np.random.Generator, times: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """
    (K, 4, 4) true poses T_map_sensor at `times` (K,) s: before the plate, then to things and back.

    The body leans and trembles by some degrees.
    """
    start = ON_GROUND * times[-1]
    keys, places, yaws, heights = [start], [np.zeros(2)], [rng.uniform(-np.pi, np.pi)], [0.4]
    while keys[-1] < times[-1]:
        target = targets[rng.integers(len(targets))]
        bearing = float(np.arctan2(*(target - places[-1])[::-1]))
        turned = yaws[-1] + (bearing - yaws[-1] + np.pi) % (2.0 * np.pi) - np.pi
        away = rng.uniform(0.4, 1.1)
        ahead = target - away * np.array([np.cos(bearing), np.sin(bearing)])
        height = rng.uniform(0.3, 1.0)
        _stop(keys, places, yaws, heights, places[-1], turned, height, abs(turned - yaws[-1]))
        reached = float(np.hypot(*(ahead - places[-1]))) / rng.uniform(0.5, 1.0)
        _stop(keys, places, yaws, heights, ahead, turned, height, reached)
        _stop(keys, places, yaws, heights, ahead, turned, height, rng.uniform(1.0, 3.0))
        back = target - rng.uniform(1.8, 3.0) * np.array([np.cos(bearing), np.sin(bearing)])
        _stop(keys, places, yaws, heights, back, turned, height, rng.uniform(3.0, 4.0))
    at = np.maximum(times, start)
    xy, yaw, z = (PchipInterpolator(keys, values)(at) for values in (places, yaws, heights))
    lean = np.radians(2.0) * np.sin(
        times[:, None] * rng.uniform(3.0, 9.0, 2) + rng.uniform(0.0, 6.0, 2)
    )
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, :3] = Rotation.from_euler('ZYX', np.column_stack([yaw, lean])).as_matrix()
    T[:, :3, 3] = np.column_stack([xy, z])
    T[times < start] = np.eye(4)
    T[times < start, 2, 3] = -1.0
    return T


def _stop(keys, places, yaws, heights, place, yaw, height, seconds_on) -> None:
    """Append a keyframe `seconds_on` after the last."""
    keys.append(keys[-1] + max(0.3, seconds_on))
    places.append(np.asarray(place))
    yaws.append(yaw)
    heights.append(height)
