"""Where the base is while it is carried: its pose at any stamp, from what measures it."""

from __future__ import annotations

from collections import deque

from continuum_loc import lie
from continuum_loc.measurements import BaseSample, EncoderSample, nanoseconds
from continuum_loc.robot import RobotDescription
import numpy as np

KEPT = 64  # samples; older instants are not asked for
LATELY = 0.2  # [s]
LEAST_MOVE, LEAST_TURN = 0.003, 0.006  # [m], [rad] that are no noise of what tells it
FARTHEST = 0.05  # [s] beyond the newest sample, over which the base goes on as it went


class BaseMotion:
    """
    Pose of the inserted base in `map`: of the description, or as it is told.

    variance: [rad^2] of its rotation about each axis, which all modules share.
    """

    def __init__(self, robot: RobotDescription) -> None:
        base = robot.base
        self._robot_base, self._told = base.T_map_base, base.mode == 'measured'
        self._latency = nanoseconds(base.measurement.latency)
        self.variance = np.radians(base.sigma_rotation_deg) ** 2 if self._told else 0.0
        self._inserted = base.insertion.mode == 'measured'
        self._travel = 0.0
        self._poses: deque[tuple[int, np.ndarray]] = deque(maxlen=KEPT)

    @property
    def known(self) -> bool:
        """Whether it can be asked for."""
        return not self._told or bool(self._poses)

    def take(self, sample: BaseSample | EncoderSample) -> bool:
        """Note where the base is told to be, or how far inserted; False for what is not used."""
        if isinstance(sample, EncoderSample):
            used = self._inserted and 'insertion' in sample.names
            if used:
                self._travel = float(sample.position[sample.names.index('insertion')])
            return used
        stamp = sample.stamp - self._latency
        newer = self._told and (not self._poses or stamp > self._poses[-1][0])
        if newer:
            self._poses.append((stamp, sample.T_frame_base))
        return newer

    def pose(self, stamp: int) -> np.ndarray:
        """T_map_base (4, 4) of the inserted base at `stamp` [ns]."""
        T = self._at(stamp) if self._told else self._robot_base
        if not self._travel:
            return T
        return T @ lie.exp(np.array([self._travel, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def rotation(self, stamp: int) -> np.ndarray:
        """R_map_base (3, 3) at `stamp` [ns]."""
        return (self._at(stamp) if self._told else self._robot_base)[:3, :3]

    def moves(self, stamp: int) -> bool:
        """Whether the base was carried on in the last `LATELY` seconds before `stamp` [ns]."""
        if not self._told or len(self._poses) < 2:
            return False
        moved = lie.log(lie.inverse(self._at(stamp - nanoseconds(LATELY))) @ self._at(stamp))
        return bool(
            np.linalg.norm(moved[:3]) > LEAST_MOVE or np.linalg.norm(moved[3:]) > LEAST_TURN
        )

    def _at(self, stamp: int) -> np.ndarray:
        """Between two samples, or at the last one's speed, along the geodesic."""
        poses = self._poses
        if len(poses) == 1:
            return poses[0][1]
        after = len(poses) - 1
        while after > 1 and poses[after - 1][0] >= stamp:
            after -= 1
        (first, T_a), (last, T_b) = poses[after - 1], poses[after]
        at = min(max(stamp, first), last + nanoseconds(FARTHEST))
        return lie.interpolate(T_a, T_b, np.array((at - first) / (last - first)))
