"""The shape estimator over a recorded bag, with the same run folder and report as the filter's."""

from __future__ import annotations

from continuum_loc.errors import SettingsError
from continuum_loc.estimate import Estimate
from continuum_loc.measurements import FieldSample, ImuSample, Measurement
from continuum_loc.robot import RobotDescription
from continuum_loc.shape import ShapeEstimate, ShapeEstimator, ShapeSettings
import numpy as np


class ShapeReplay:
    """
    `ShapeEstimator` in the form that `replay.replay` asks of a filter.

    Poses are those of the modules' rings.

    The base is where the description says, exactly; strain and velocity are not estimated, and
    nan.
    """

    def __init__(self, robot: RobotDescription, settings: ShapeSettings) -> None:
        self.estimator = ShapeEstimator(robot, settings)
        if self.estimator.module_names != robot.ring_names:
            raise SettingsError(
                f"robot '{robot.name}': shape needs a Hall sensor on every ring, in the rings' "
                f'order; rings: {", ".join(robot.ring_names)}; with Hall sensor: '
                f'{", ".join(self.estimator.module_names) or "none"}'
            )
        self.robot, self.settings = robot, settings

    @property
    def counts(self) -> dict:
        """Count what the estimator received and used."""
        return {'samples': dict(self.estimator.counts)}

    def process(self, measurement: Measurement) -> Estimate | None:
        """One sample; kinds that shape does not use are passed by."""
        if not isinstance(measurement, (ImuSample, FieldSample)):
            return None
        shape = self.estimator.process(measurement)
        return None if shape is None else as_estimate(shape, self.robot.base.T_map_base)

    def flush(self) -> None:
        """Nothing is pending: every estimate is made at its instant."""


def as_estimate(shape: ShapeEstimate, T_map_base: np.ndarray) -> Estimate:
    """Give the shape as an `Estimate` of base and rings."""
    rings = 1 + len(shape.modules)
    unknown = np.full((rings, 6), np.nan)
    T_map_backbone = np.tile(np.eye(4), (len(shape.curve), 1, 1))
    T_map_backbone[:, :3, 3] = shape.curve
    return Estimate(
        stamp=shape.stamp,
        T_map_ring=np.concatenate([T_map_base[None], shape.T_map_module]),
        covariance=np.concatenate([np.full((1, 6, 6), np.nan), shape.covariance]),
        strain=unknown,
        velocity=unknown,
        velocity_covariance=np.full((rings, 6, 6), np.nan),
        backbone_s=shape.curve_s,
        T_map_backbone=T_map_backbone,
        status='lost' if shape.faults else 'tracking',
        consistency=shape.consistency,
        suspects={name: ', '.join(reasons) for name, reasons in shape.faults.items()},
    )
