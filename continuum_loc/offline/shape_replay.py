"""The shape estimator over a recorded bag, with the same run folder and report as the filter's."""

from __future__ import annotations

from collections import Counter
from typing import Any

from continuum_loc.errors import SettingsError
from continuum_loc.estimate import Estimate
from continuum_loc.measurements import Measurement
from continuum_loc.robot import RobotDescription
from continuum_loc.shape import ShapeEstimate, ShapeEstimator, ShapeSettings
import numpy as np


class ShapeReplay:
    """
    `ShapeEstimator` in the form that `replay.replay` asks of a filter.

    Poses are those of the modules' rings. The base is where the description says, or where it is
    told to be; strain and velocity are not estimated, and nan.
    """

    inputs = ('imu/data_raw', 'imu/mag', 'joint_states', 'base/pose', 'base/odom')

    def __init__(self, robot: RobotDescription, settings: ShapeSettings) -> None:
        self.estimator = ShapeEstimator(robot, settings)
        if self.estimator.module_names != robot.ring_names:
            raise SettingsError(
                f"robot '{robot.name}': shape needs a Hall sensor on every ring, in the rings' "
                f'order; rings: {", ".join(robot.ring_names)}; with Hall sensor: '
                f'{", ".join(self.estimator.module_names) or "none"}'
            )
        self.robot, self.settings = robot, settings
        self._received: Counter[str] = Counter()
        self._used: Counter[str] = Counter()
        self._earlier: Counter[str] = Counter()  # than the last new start
        self._points: int | None = None

    @property
    def counts(self) -> dict[str, Any]:
        """Count what the estimator received, used by kind, and dropped by reason."""
        counted = self._earlier + self.estimator.counts
        counted.pop('used', None)
        return {
            'received': dict(self._received),
            'used': dict(self._used),
            'dropped': dict(counted),
        }

    def process(self, measurement: Measurement) -> Estimate | None:
        """Take one sample; an estimate when one fell due."""
        kind, before = type(measurement).__name__, self.estimator.counts['used']
        self._received[kind] += 1
        shape = self.estimator.process(measurement)
        self._used[kind] += self.estimator.counts['used'] - before
        if shape is None:
            return None
        curve, s = self._evened(shape)
        return as_estimate(shape, curve, s)

    def reset(self) -> None:
        """Start over with taring."""
        self._earlier += self.estimator.counts
        self.estimator.reset()

    def flush(self) -> None:
        """Nothing is pending: every estimate is made at its instant."""

    def _evened(self, shape: ShapeEstimate) -> tuple[np.ndarray, np.ndarray]:
        """
        Give the curve as many points as the first one had.

        How many it takes from the last module to the tip depends on where the module is.
        """
        curve, s = shape.curve, shape.curve_s
        self._points = self._points or len(s)
        if len(s) == self._points:
            return curve, s
        at = np.linspace(s[0], s[-1], self._points)
        return np.column_stack([np.interp(at, s, column) for column in curve.T]), at


def as_estimate(shape: ShapeEstimate, curve: np.ndarray, curve_s: np.ndarray) -> Estimate:
    """Give the shape and a curve (C, 3) at arclengths (C,) as an `Estimate` of base and rings."""
    rings = 1 + len(shape.modules)
    unknown = np.full((rings, 6), np.nan)
    T_map_backbone = np.tile(np.eye(4), (len(curve), 1, 1))
    T_map_backbone[:, :3, 3] = curve
    return Estimate(
        stamp=shape.stamp,
        T_map_ring=np.concatenate([shape.T_map_base[None], shape.T_map_module]),
        covariance=np.concatenate([np.full((1, 6, 6), np.nan), shape.covariance]),
        strain=unknown,
        velocity=unknown,
        velocity_covariance=np.full((rings, 6, 6), np.nan),
        backbone_s=curve_s,
        T_map_backbone=T_map_backbone,
        status='lost' if shape.faults else 'tracking',
        consistency=shape.consistency,
        suspects={name: ', '.join(reasons) for name, reasons in shape.faults.items()},
    )
