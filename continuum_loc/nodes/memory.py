"""
What the estimator node keeps of the past, in bounded memory.

The newest trajectory, and the scene it saw.
"""

from __future__ import annotations

from collections import deque

from continuum_loc.estimator.estimate import Estimate
from continuum_loc.evaluation.tracks import BASE, Track
from continuum_loc.measurements import nanoseconds, TofFrame
from continuum_loc.robot import RobotDescription
from msg_tools.records import CloudRecord
import numpy as np


class Trajectory:
    """The poses of the newest `duration` seconds."""

    def __init__(self, duration: float) -> None:
        self.duration = nanoseconds(duration)
        self._poses: deque[tuple[int, np.ndarray]] = deque()

    def add(self, estimate: Estimate) -> None:
        """Keep an estimate's poses; a repeated instant is replaced."""
        while self._poses and self._poses[-1][0] >= estimate.stamp:
            self._poses.pop()
        self._poses.append((estimate.stamp, estimate.T_map_ring.copy()))
        while self._poses[0][0] < estimate.stamp - self.duration:
            self._poses.popleft()

    def recent(self, count: int) -> list[int]:
        """Return the newest `count` stamps."""
        return [stamp for stamp, _ in list(self._poses)[-count:]]

    def track(self, robot: RobotDescription) -> Track:
        """All that is kept."""
        poses = list(self._poses)  # the worker may add meanwhile
        names = (BASE, *robot.ring_names)
        if not poses:
            return Track.empty(names)
        return Track(
            np.array([stamp for stamp, _ in poses], np.int64),
            names,
            np.stack([T for _, T in poses]),
        )


class SeenScene:
    """ToF points placed in `map` by the estimate, for the newest `duration` seconds."""

    def __init__(self, robot: RobotDescription) -> None:
        self._ring = {sensor.name: 1 + robot.ring_names.index(sensor.ring) for sensor in robot.tof}
        self._T_ring_sensor = {sensor.name: sensor.mount.T_ring_sensor for sensor in robot.tof}
        self._waiting: list[TofFrame] = []
        self._seen: deque[tuple[int, np.ndarray]] = deque()

    def see(self, frame: TofFrame) -> None:
        """Keep a frame that the next estimate places."""
        self._waiting.append(frame)

    def place(self, estimate: Estimate, duration: float) -> None:
        """
        Place the waiting frames by an estimate made at their instant.

        What is older than `duration` [s] is forgotten.
        """
        frames = [
            frame
            for frame in self._waiting
            if abs(frame.stamp - estimate.stamp) < nanoseconds(0.005)
        ]
        self._waiting = []
        if frames and estimate.status == 'tracking':
            self._seen.append(
                (
                    estimate.stamp,
                    np.concatenate([self._placed(frame, estimate) for frame in frames]),
                )
            )
        while self._seen and self._seen[0][0] < estimate.stamp - nanoseconds(duration):
            self._seen.popleft()

    def clear(self) -> None:
        """Forget everything."""
        self._waiting = []
        self._seen.clear()

    def columns(self) -> np.ndarray:
        """(N, 4) x, y, z in `map` and standard deviation [m]."""
        return np.concatenate([np.empty((0, 4)), *(points for _, points in list(self._seen))])

    def record(self, stamp: int, anomaly: np.ndarray | None = None) -> CloudRecord:
        """Return the points as the `reconstruction` topic carries them."""
        x, y, z, sigma = self.columns().T
        return CloudRecord(
            stamp,
            {
                'x': x,
                'y': y,
                'z': z,
                'sigma': sigma,
                'anomaly': np.zeros_like(x) if anomaly is None else anomaly,
            },
        )

    def _placed(self, frame: TofFrame, estimate: Estimate) -> np.ndarray:
        """
        (N, 4) of the zones with a return.

        The standard deviation is the beam's and the ring's together, eq. 11.
        """
        ring = self._ring[frame.sensor]
        T_map_sensor = estimate.T_map_ring[ring] @ self._T_ring_sensor[frame.sensor]
        valid = np.isfinite(frame.ranges)
        points = frame.points[valid] @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3]
        beam = np.nan_to_num(frame.sigma[valid], nan=0.0)
        position = np.trace(estimate.covariance[ring, :3, :3]) / 3.0
        rotation = np.trace(estimate.covariance[ring, 3:, 3:]) / 3.0
        sigma = np.sqrt(beam**2 + position + rotation * frame.ranges[valid] ** 2)
        return np.column_stack([points, sigma])
