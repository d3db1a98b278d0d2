"""Hall sensor: the field of the magnet at the base (and Earth's), in the body frame."""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator.factors.base import Factor, FactorReport, known_sensor
from continuum_loc.estimator.interpolation import interpolated
from continuum_loc.estimator.normal import add_rows
from continuum_loc.estimator.state import rows_in_time
from continuum_loc.magnet import field_residual_and_jacobian
from continuum_loc.measurements import FieldSample
import numpy as np


class Row(NamedTuple):
    """One sample: field (3,) in the node's frame [T], and one over its variance."""

    node: int
    measured: np.ndarray
    weight: float


class Batch(NamedTuple):
    times: np.ndarray
    nodes: np.ndarray
    measured: np.ndarray
    weights: np.ndarray


class FieldFactor(Factor):
    """Three-axis field at a node; its noise is the sensor's and, for the model, a share of it."""

    name = 'field'
    consumes = FieldSample
    batch = Batch

    def __init__(self, setup):
        super().__init__(setup)
        robot, grid = self.robot, self.grid
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

    def row(self, measurement: FieldSample) -> Row:
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
        return Row(node, R_ring_hall @ measurement.field, sigma**-2.0)

    def linearise(self, batch, a, b, normal):
        at = interpolated(a, b, batch.times, batch.nodes, pose=True)
        earth = np.array(self.settings.field.earth)
        e, J = field_residual_and_jacobian(
            at.T, self.robot.magnet, self._T_map_magnet, batch.measured, earth
        )
        u2 = batch.weights * np.sum(e**2, axis=1)
        cauchy2 = self.settings.field.cauchy**2
        robust = 1.0 / (1.0 + u2 / cauchy2)
        weights = np.repeat((batch.weights * robust)[:, None], 3, axis=1)
        rows, index = J @ at.J_pose, np.empty(24, np.int64)
        for m, node in enumerate(batch.nodes):
            rows_in_time(node, self.grid.dim, index)
            add_rows(normal, index, e[m], rows[m], weights[m])
        cost = float(np.sum(0.5 * cauchy2 * np.log1p(u2 / cauchy2)))
        return FactorReport(cost, float(u2 @ robust), 3 * len(u2))
