"""
A small analytic world for the filter's tests.

A bent rod that moves by a formula, in a room of planes.

Everything is exact and needs no simulator: constant-curvature segments between rings, rays against
planes.
"""

from __future__ import annotations

from collections.abc import Iterator

from continuum_loc import lie
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import ImuSample, nanoseconds, StrainSample, TofFrame, TruthSample
from continuum_loc.robot import RobotDescription, Tolerances
from continuum_loc.settings import parse_settings
import numpy as np

# Inward-looking walls of a room and of a step in it: (normal, point on the plane, corners'
# extent).
ROOM = np.array([[-0.5, -0.7, -0.6], [1.3, 0.8, 0.7]])
EPOCH = 1_000_000_000
# Nothing here departs from its description, unless a test lets it.
EXACT = dict.fromkeys(Tolerances.model_fields, 0.0)


def rod(strain: bool = True, tof: bool = True) -> RobotDescription:
    """
    Describe a rod of 0.6 m with rings at 0.3 m and 0.6 m.

    Three radial ToF sensors each and one at the tip.
    """
    sensors = [
        {
            'name': f'r{r}_tof{i}',
            'ring': f'r{r}',
            'mount': {'azimuth_deg': 60.0 * r + 120.0 * i, 'radius': 0.02},
        }
        for r in (1, 2)
        for i in range(3)
    ]
    sensors.append(
        {
            'name': 'tip_tof',
            'ring': 'r2',
            'mount': {'xyz': [0.005, 0.0, 0.0], 'rpy_deg': [0.0, 0.0, 0.0]},
        }
    )
    return parse_settings(
        RobotDescription,
        {
            'name': 'rod',
            'length': 0.6,
            'radius': 0.02,
            'rings': [{'name': 'r1', 's': 0.3}, {'name': 'r2', 's': 0.6}],
            'tof': sensors if tof else [],
            'imu': [{'name': f'r{r}_imu', 'ring': f'r{r}'} for r in (1, 2)],
            'strain': {'spacing': 0.05} if strain else None,
            'tolerances': EXACT,
        },
    )


class Rod:
    """The rod's true motion: each half bends by its own sinusoids, after 0.5 s at rest."""

    def __init__(self, robot: RobotDescription, seed: int = 0, amplitude: float = 0.6):
        rng = np.random.default_rng(seed)
        self.robot = robot
        self.amplitude = amplitude * rng.uniform(0.5, 1.0, size=(2, 2))
        self.phase, self.rate = rng.uniform(0, 2 * np.pi, (2, 2)), rng.uniform(1.0, 2.5, (2, 2))

    def curvature(self, time: float) -> np.ndarray:
        """(2, 2) curvatures of both halves."""
        moving = max(time - 0.5, 0.0)
        ramp = moving**2 / (1.0 + moving**2)
        return self.amplitude * np.sin(self.phase + ramp * self.rate * moving)

    def poses(self, time: float, s: np.ndarray) -> np.ndarray:
        """(..., 4, 4) true poses at arclengths s."""
        strain = np.zeros((2, 6))
        strain[:, 0], strain[:, 4:] = 1.0, self.curvature(time)
        T_middle = lie.exp(0.3 * strain[0])
        first = lie.exp(np.minimum(s, 0.3)[:, None] * strain[0])
        second = T_middle @ lie.exp(np.maximum(s - 0.3, 0.0)[:, None] * strain[1])
        return np.where((s <= 0.3)[:, None, None], first, second)

    def rings(self, time: float) -> np.ndarray:
        return self.poses(time, np.array([0.0, *self.robot.ring_arclengths]))

    def rates(self, time: float) -> np.ndarray:
        """(R + 1, 6) body velocities by central differences."""
        step = 1e-5
        return lie.log(lie.inverse(self.rings(time - step)) @ self.rings(time + step)) / (
            2.0 * step
        )


def cast(origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(N,) distances to the room's walls from inside."""
    with np.errstate(divide='ignore', invalid='ignore'):
        hits = (ROOM[:, None, :] - origins) / rays
    return np.min(np.where(hits > 1e-6, hits, np.inf), axis=(0, 2))


def room_map(spacing: float = 0.02) -> PriorMap:
    """Make a map of the room's walls, with exact normals."""
    points, normals = [], []
    for axis in range(3):
        u, v = (i for i in range(3) if i != axis)
        ticks = (np.arange(ROOM[0, i] + 0.5 * spacing, ROOM[1, i], spacing) for i in (u, v))
        grid = np.stack(np.meshgrid(*ticks, indexing='ij'), -1)
        for side in range(2):
            wall = np.empty((grid.shape[0] * grid.shape[1], 3))
            wall[:, axis], wall[:, u], wall[:, v] = (
                ROOM[side, axis],
                grid[..., 0].ravel(),
                grid[..., 1].ravel(),
            )
            normal = np.zeros(3)
            normal[axis] = 1.0 if side == 0 else -1.0
            points.append(wall)
            normals.append(np.tile(normal, (len(wall), 1)))
    points, normals = np.concatenate(points), np.concatenate(normals)
    return PriorMap(points=points, normals=normals, planarity=np.ones(len(points)), sigma=1e-4)


def stream(rod_: Rod, duration: float, seed: int = 0, start: float = 0.0) -> Iterator:
    """Yield samples with datasheet noise and TruthSamples, in the order of their stamps."""
    rng, robot = np.random.default_rng(seed), rod_.robot
    tick = 1.0 / 300.0
    for k in range(int(round(start / tick)), int(round((start + duration) / tick)) + 1):
        time = k * tick
        stamp = EPOCH + nanoseconds(time)
        if k % 3 == 0 or k % 20 == 0:
            yield TruthSample(stamp, rod_.rings(time))
        if k % 3 == 0:
            rates = rod_.rates(time)
            for number, imu in enumerate(robot.imu):
                noise = robot.imu_model.gyro_sigma * rng.normal(size=3)
                yield ImuSample(
                    stamp, imu.name, rates[number + 1, 3:] + noise, np.array([0.0, 0.0, 9.81])
                )
        if k % 15 == 0 and robot.strain is not None:
            yield strain_sample(rod_, time, stamp, rng)
        if k % 20 == 0:
            yield from tof_frames(rod_, time, stamp, rng)


def strain_sample(rod_: Rod, time: float, stamp: int, rng: np.random.Generator) -> StrainSample:
    s = rod_.robot.strain_stations
    bend = rod_.curvature(time)[(s > 0.3).astype(int)]
    kappa, theta = np.hypot(*bend.T), np.arctan2(-bend[:, 0], bend[:, 1])
    noise = rod_.robot.strain
    return StrainSample(
        stamp,
        s,
        theta + noise.theta_sigma * rng.normal(size=len(s)),
        kappa + noise.kappa_sigma * rng.normal(size=len(s)),
    )


def tof_frames(rod_: Rod, time: float, stamp: int, rng: np.random.Generator) -> Iterator[TofFrame]:
    robot = rod_.robot
    rings, rays = rod_.rings(time), robot.tof_model.directions
    for sensor in robot.tof:
        T_map_sensor = rings[1 + robot.ring_names.index(sensor.ring)] @ sensor.mount.T_ring_sensor
        directions = rays @ T_map_sensor[:3, :3].T
        distance = cast(np.broadcast_to(T_map_sensor[:3, 3], directions.shape), directions)
        sigma = robot.tof_model.sigma(distance)
        measured = distance + sigma * rng.normal(size=len(distance))
        yield TofFrame(
            stamp,
            sensor.name,
            measured[:, None] * rays,
            measured,
            sigma,
            np.full(len(rays), 5, np.uint8),
        )
