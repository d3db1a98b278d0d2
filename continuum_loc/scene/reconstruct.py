"""
The scene as the sensors saw it (paper, eqs. 10-11).

Every ToF zone is projected into the map with its covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.compiling import kernel
from continuum_loc.errors import MapError
from continuum_loc.extras import require
from continuum_loc.formats.ply_writer import write_ply
from continuum_loc.measurements import TOF_HALF_CONFIDENT, TOF_VALID, TofFrame
from continuum_loc.robot import RobotDescription
from continuum_loc.trajectory import Trajectory
import numpy as np

CHUNK = 50_000  # points whose covariances are computed at a time


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """
    N measured surface points in `map`, and M beams that met nothing.

    points, origins: (N, 3) [m], where the beam ended and began; covariance: (N, 3, 3) [m^2] of
    `points`; range_sigma: (N,) [m] its share along the beam that is the range's own.
    stamps: (N,) ns; sensors: names; sensor: (N,) number of the sensor in `sensors`.
    open_origins, open_ends: (M, 3) [m] of beams without a return, ending at the sensor's greatest
    range.
    skipped: frames that lay outside the trajectory's time; on_body: zones dropped because they saw
    the robot itself.
    """

    points: np.ndarray
    covariance: np.ndarray
    range_sigma: np.ndarray
    origins: np.ndarray
    stamps: np.ndarray
    sensor: np.ndarray
    sensors: tuple[str, ...]
    open_origins: np.ndarray
    open_ends: np.ndarray
    skipped: int = 0
    on_body: int = 0

    @classmethod
    def joined(cls, parts: Sequence[Reconstruction]) -> Reconstruction:
        """One of several reconstructions by the same robot, in their order."""
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name, value in vars(parts[0]).items()
            if isinstance(value, np.ndarray)
        }
        counts = {
            name: sum(getattr(part, name) for part in parts) for name in ('skipped', 'on_body')
        }
        return cls(**arrays, sensors=parts[0].sensors, **counts)

    @property
    def sigma(self) -> np.ndarray:
        """(N,) root mean square over the axes of each point's standard deviation [m]."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 3.0)

    def save(self, path: str | Path, anomaly: np.ndarray | None = None) -> None:
        """
        Write a `.ply`.

        It has x, y, z, sigma, the covariance's upper triangle, seconds since the first point, the
        sensor's number and, if given, `anomaly` (N,).
        """
        if Path(path).suffix.lower() != '.ply':
            raise MapError(f'{path}: a reconstruction is written as .ply')
        rows, columns = np.triu_indices(3)
        names = ['cxx', 'cxy', 'cxz', 'cyy', 'cyz', 'czz']
        fields = dict(zip('xyz', self.points.T, strict=True)) | {
            'sigma': self.sigma.astype(np.float32)
        }
        fields |= dict(
            zip(names, self.covariance[:, rows, columns].T.astype(np.float32), strict=True)
        )
        first = self.stamps.min() if len(self.stamps) else 0
        fields |= {'time': (self.stamps - first) * 1e-9, 'sensor': self.sensor.astype(np.int32)}
        if anomaly is not None:
            fields['anomaly'] = np.asarray(anomaly).astype(np.uint8)
        write_ply(path, fields)

    def distances_to_mesh(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """(N,) distance [m] of each point to a mesh (V, 3), (F, 3)."""
        return distances_to_mesh(self.points, vertices, faces)


def reconstruct(
    robot: RobotDescription,
    frames: Sequence[TofFrame],
    trajectory: Trajectory,
    *,
    floor: float = 0.001,
    beam_width_deg: float = 0.0,
    body_margin: float = 0.01,
) -> Reconstruction:
    """
    Project every usable zone of `frames` into the map (eq. 10) with its covariance (eq. 11).

    The noise of a zone lies along its beam: the variance the sensor states for the range (Table I
    of the paper where it states none), and across it that of a footprint of `beam_width_deg`
    (uniform; 0 for the paper's thin rays); `floor` [m] is added in all directions for what is not
    modelled. A pose error delta = [rho; phi] of the ring moves a point q of the ring's frame by R
    (rho + phi x q), so that its share is R [I, -q^] Sigma [I, -q^]^T R^T. Zones within
    `body_margin` [m] of the robot's own surface are dropped and counted.
    """
    stack = _stacked(robot, frames, trajectory)
    T_ring_sensor = np.stack([sensor.mount.T_ring_sensor for sensor in robot.tof])[stack.sensor]
    ring_of = np.array([robot.ring_names.index(sensor.ring) + 1 for sensor in robot.tof])
    rings = ring_of[stack.sensor]
    T_map_ring, pose_covariance = trajectory.rings_at(stack.stamps, rings)
    T_map_sensor = T_map_ring @ T_ring_sensor
    in_map = (
        np.einsum('fij,fzj->fzi', T_map_sensor[:, :3, :3], stack.points)
        + T_map_sensor[:, None, :3, 3]
    )
    itself = stack.usable & _on_body(
        in_map, trajectory, stack.stamps, max(robot.radius + body_margin, 0.0)
    )
    frame_of, zone = np.nonzero(stack.usable & ~itself)
    covariance = np.empty((len(frame_of), 3, 3))
    for start in range(0, len(frame_of), CHUNK):
        own, zones = (which[start:][:CHUNK] for which in (frame_of, zone))
        covariance[start:][:CHUNK] = _point_covariance(
            T_map_ring[own, :3, :3],
            pose_covariance[own],
            T_ring_sensor[own],
            stack.points[own, zones],
            stack.sigma[own, zones],
            floor,
            np.radians(beam_width_deg),
        )
    open_frame, open_zone = np.nonzero(np.isposinf(stack.ranges))
    open_ends = robot.tof_model.max_range * robot.tof_model.directions[open_zone]
    return Reconstruction(
        points=in_map[frame_of, zone],
        covariance=covariance,
        range_sigma=stack.sigma[frame_of, zone],
        origins=T_map_sensor[frame_of, :3, 3],
        stamps=stack.stamps[frame_of],
        sensor=stack.sensor[frame_of],
        sensors=tuple(s.name for s in robot.tof),
        open_origins=T_map_sensor[open_frame, :3, 3],
        open_ends=_transform(T_map_sensor[open_frame], open_ends),
        skipped=stack.skipped,
        on_body=int(itself.sum()),
    )


class _Stack(NamedTuple):
    """
    F frames of Z zones as arrays.

    Stamps (F,), number of the sensor (F,), points (F, Z, 3), ranges, sigma and usable (F, Z); and
    how many frames lie outside the trajectory's time.
    """

    stamps: np.ndarray
    sensor: np.ndarray
    points: np.ndarray
    ranges: np.ndarray
    sigma: np.ndarray
    usable: np.ndarray
    skipped: int


def _stacked(
    robot: RobotDescription, frames: Sequence[TofFrame], trajectory: Trajectory
) -> _Stack:
    first, last = trajectory.stamps[0], trajectory.stamps[-1]
    inside = [frame for frame in frames if first <= frame.stamp <= last]
    if not inside:
        raise MapError(
            f"none of the {len(frames)} ToF frames lies within the trajectory's "
            f'time, {first} to {last} ns'
        )
    names = [sensor.name for sensor in robot.tof]
    strange = sorted({frame.sensor for frame in inside} - set(names))
    if strange:
        raise MapError(
            f'frames of {", ".join(strange)}; '
            f"robot '{robot.name}' has the ToF sensors {', '.join(names)}"
        )
    zones = len(robot.tof_model.directions)
    for frame in inside:
        if frame.points.shape != (zones, 3) or frame.ranges.shape != (zones,):
            raise MapError(
                f'a frame of {frame.sensor} has points {frame.points.shape}, '
                f"the robot's ToF model {zones} zones"
            )
    ranges, sigma, status = (
        np.stack([getattr(frame, name) for frame in inside])
        for name in ('ranges', 'sigma', 'status')
    )
    usable = np.isfinite(ranges) & np.isin(status, (TOF_VALID, *TOF_HALF_CONFIDENT))
    return _Stack(
        stamps=np.array([frame.stamp for frame in inside], np.int64),
        sensor=np.array([names.index(frame.sensor) for frame in inside]),
        points=np.stack([frame.points for frame in inside]).astype(np.float64),
        ranges=ranges,
        sigma=np.where(np.isfinite(sigma), sigma, robot.tof_model.sigma(ranges)),
        usable=usable,
        skipped=len(frames) - len(inside),
    )


def _on_body(points, trajectory, stamps, distance, samples=8):
    """
    (F, Z) whether points (F, Z, 3) at `stamps` (F,) lie within `distance` of the backbone.

    It is drawn through the base and the rings as a Hermite cubic (their x axes are its tangents).
    """
    nodes = trajectory.T_map_ring.shape[1]
    u = np.linspace(0.0, 1.0, samples, endpoint=False)[:, None]
    on = np.zeros(points.shape[:2], bool)
    for start in range(0, len(stamps), 256):
        part = slice(start, start + 256)
        moments, which = np.broadcast_arrays(stamps[part, None], np.arange(nodes))
        T = trajectory.rings_at(moments.ravel(), which.ravel())[0].reshape(-1, nodes, 4, 4)
        a, b = T[:, :-1, None, :3, 3], T[:, 1:, None, :3, 3]
        chord = np.linalg.norm(b - a, axis=-1, keepdims=True)
        va, vb = chord * T[:, :-1, None, :3, 0], chord * T[:, 1:, None, :3, 0]
        curve = a + u**2 * (3 - 2 * u) * (b - a) + u * (1 - u) ** 2 * va - u**2 * (1 - u) * vb
        backbone = np.concatenate([curve.reshape(len(T), -1, 3), T[:, -1:, :3, 3]], axis=1)
        on[part] = _within(points[part], backbone, distance)
    return on


@kernel
def _within(points, polyline, distance):
    """(F, Z) whether points (F, Z, 3) are within `distance` of their polyline (F, K, 3)."""
    out = np.zeros(points.shape[:2], np.bool_)
    for f in range(points.shape[0]):
        for z in range(points.shape[1]):
            for k in range(polyline.shape[1] - 1):
                if (
                    _segment_distance2(points[f, z], polyline[f, k], polyline[f, k + 1])
                    < distance * distance
                ):
                    out[f, z] = True
                    break
    return out


@kernel
def _segment_distance2(p, a, b):
    along, span, total = 0.0, 0.0, 0.0
    for axis in range(3):
        along += (p[axis] - a[axis]) * (b[axis] - a[axis])
        span += (b[axis] - a[axis]) ** 2
    share = min(max(along / span, 0.0), 1.0) if span > 0.0 else 0.0
    for axis in range(3):
        total += (p[axis] - a[axis] - share * (b[axis] - a[axis])) ** 2
    return total


def _transform(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) by transforms (N, 4, 4)."""
    return np.einsum('nij,nj->ni', T[:, :3, :3], points) + T[:, :3, 3]


def _point_covariance(
    R_map_ring, pose_covariance, T_ring_sensor, q_sensor, sigma, floor, beam_width
):
    """
    (N, 3, 3) covariance in the map.

    The pose's share by its Jacobian, the beam's in its own axes.
    """
    q_ring = _transform(T_ring_sensor, q_sensor)
    jacobian = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(q_ring), 3, 3)), -lie.hat(q_ring)], axis=2
    )
    in_ring = jacobian @ pose_covariance @ jacobian.transpose(0, 2, 1)
    length = np.linalg.norm(q_sensor, axis=1)
    beam = np.einsum('nij,nj->ni', T_ring_sensor[:, :3, :3], q_sensor / length[:, None])
    across = (length * beam_width) ** 2 / 12.0
    in_ring += (sigma**2 - across)[:, None, None] * beam[:, :, None] * beam[:, None, :]
    in_ring += (across + floor**2)[:, None, None] * np.eye(3)
    return R_map_ring @ in_ring @ R_map_ring.transpose(0, 2, 1)


def distances_to_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(N,) unsigned distance [m] of points (N, 3) to a triangle mesh (V, 3), (F, 3)."""
    open3d = require('open3d', 'simulate')

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(np.asarray(vertices, np.float32), np.asarray(faces, np.uint32))
    return (
        scene.compute_distance(np.asarray(points, np.float32), nthreads=1)
        .numpy()
        .astype(np.float64)
    )


def root_mean_square(distances: np.ndarray) -> float:
    """Per-point RMSE [m] of distances (N,) [m]."""
    return float(np.sqrt(np.mean(np.square(distances))))
