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
            self._T_base_magnet = lie.exp(along)
            self._T_map_magnet = robot.base.T_map_base @ self._T_base_magnet
        # A base that is carried or inserted takes the magnet along.
        self._goes = robot.base.mode != 'fixed' or robot.base.insertion.mode != 'fixed'

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
        base = interpolated(a, b, batch.times, np.zeros_like(batch.nodes), pose=True)
        e, J, J_base = self._residuals(batch, at.T, base.T)
        u2 = batch.weights * np.sum(e**2, axis=1)
        cauchy2 = self.settings.field.cauchy**2
        robust = 1.0 / (1.0 + u2 / cauchy2)
        weights = np.repeat((batch.weights * robust)[:, None], 3, axis=1)
        own, of_base, index = J @ at.J_pose, J_base @ base.J_pose, np.empty(24, np.int64)
        for m, node in enumerate(batch.nodes):
            rows_in_time(node, self.grid.dim, index)
            rows, all_rows = index, own[m]
            if self._goes and node == 0:
                all_rows = own[m] + of_base[m]
            elif self._goes:
                rows, all_rows = self._with_base(index, own[m], of_base[m])
            add_rows(normal, rows, e[m], all_rows, weights[m])
        cost = float(np.sum(0.5 * cauchy2 * np.log1p(u2 / cauchy2)))
        return FactorReport(cost, float(u2 @ robust), 3 * len(u2))

    def _residuals(
        self, batch: Batch, T: np.ndarray, T_map_base: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (M, 3), and Jacobians (M, 3, 6) by the nodes' poses and by the base's."""
        magnet, earth = self.robot.magnet, np.array(self.settings.field.earth)
        if not self._goes:
            e, J = field_residual_and_jacobian(
                T, magnet, self._T_map_magnet, batch.measured, earth
            )
            return e, J, np.zeros_like(J)
        # The magnet's own field, in a frame that goes with the base; Earth's does not.
        T_base_node = lie.inverse(T_map_base) @ T
        source, J = field_residual_and_jacobian(
            T_base_node, magnet, self._T_base_magnet, np.zeros((len(T), 3))
        )
        J_base = -J @ lie.adjoint(lie.inverse(T_base_node))
        background = np.einsum('mji,j->mi', T[:, :3, :3], earth)
        J[:, :, 3:] += lie.hat(background)
        return source + background - batch.measured, J, J_base

    def _with_base(
        self, index: np.ndarray, own: np.ndarray, of_base: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows (48,) of the first node and of another, in increasing order, and J (3, 48)."""
        base = np.empty(24, np.int64)
        rows_in_time(0, self.grid.dim, base)
        rows = np.concatenate([base[:12], index[:12], base[12:], index[12:]])
        J = np.concatenate([of_base[:, :12], own[:, :12], of_base[:, 12:], own[:, 12:]], axis=1)
        return rows, np.ascontiguousarray(J)
