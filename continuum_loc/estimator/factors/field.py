"""
Hall sensor: the field of the magnet at the base (and Earth's), in the body frame.

See `magnet.py`.
"""

from __future__ import annotations

from continuum_loc import lie
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, known_sensor
from continuum_loc.estimator.output import interpolated_poses
from continuum_loc.estimator.state import VELOCITY
from continuum_loc.magnet import field_residual_and_jacobian
from continuum_loc.measurements import FieldSample
import numpy as np


class FieldFactor(Factor):
    """
    Three-axis field at a node.

    Its noise is the sensor's, and a share of the field for what the model lacks.
    """

    name = 'field'
    consumes = FieldSample

    def __init__(self, robot, grid, settings):
        super().__init__(robot, grid, settings)
        self._sensors = {
            hall.name: (
                grid.node_at(robot.sensor_arclength(hall.name)),
                hall.mount.T_ring_sensor[:3, :3],
            )
            for hall in robot.hall
        }
        if robot.magnet is not None:
            along = np.array([robot.magnet.s, 0.0, 0.0, 0.0, 0.0, 0.0])
            self._T_map_magnet = robot.base.T_map_base @ lie.exp(along)

    def row(self, measurement: FieldSample) -> tuple:
        if self.robot.magnet is None:
            raise MeasurementError('not used', f"robot '{self.robot.name}' has no magnet")
        node, R_ring_hall = known_sensor(self._sensors, measurement.sensor, 'Hall')
        if not np.all(np.isfinite(measurement.field)):
            raise MeasurementError(
                'saturated', f"field of '{measurement.sensor}' is saturated or not finite"
            )
        options = self.settings.field
        sigma = np.hypot(
            options.scale * self.robot.hall_model.sigma,
            options.share * np.linalg.norm(measurement.field),
        )
        return node, R_ring_hall @ measurement.field, sigma**-2.0

    def stack(self, times, rows):
        return (
            times,
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]),
        )

    def linearise(self, batch, a, b, blocks):
        times, nodes, measured, weights = batch
        T, J_pose = interpolated_poses(a, b, times, nodes)
        e, J = field_residual_and_jacobian(
            T, self.robot.magnet, self._T_map_magnet, measured, np.array(self.settings.field.earth)
        )
        u2 = weights * np.sum(e**2, axis=1)
        cauchy2 = self.settings.field.cauchy**2
        robust = 1.0 / (1.0 + u2 / cauchy2)
        rows, index = J @ J_pose, np.empty(24, np.int64)
        for m, node in enumerate(nodes):
            gp.time_index(node, VELOCITY, self.grid.dim, index)
            gp.add_rows(
                blocks.H, blocks.g, index, e[m], rows[m], np.full(3, weights[m] * robust[m])
            )
        return FactorReport(
            float(np.sum(0.5 * cauchy2 * np.log1p(u2 / cauchy2))),
            float(u2 @ robust),
            3 * len(times),
        )
