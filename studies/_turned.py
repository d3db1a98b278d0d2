"""A fault of the studies alone: a ToF sensor that was knocked out of its mount."""

from __future__ import annotations

from dataclasses import dataclass, replace

from continuum_loc.measurements import TofFrame
from continuum_loc.simulator.faults import Fault
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, kw_only=True)
class Turned(Fault):
    """
    A ToF sensor knocked out of its mount.

    Its points belong `angle_deg` away, about its z axis, from where the robot description puts
    them.
    """

    angle_deg: float = 20.0

    def alter(self, sample, rng, memory):
        if not isinstance(sample, TofFrame):
            return sample
        turn = Rotation.from_euler('z', self.angle_deg, degrees=True)
        return replace(sample, points=turn.apply(sample.points))
