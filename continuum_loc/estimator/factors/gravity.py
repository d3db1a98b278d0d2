"""
Accelerometer as gravity's direction: R^T g_up + noise, while the motion is quasi-static.

A body-frame observation of a known map vector; e = R^T up |g| - f, de/dphi = hat(R^T up |g|).
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, known_sensor, require_finite
from continuum_loc.estimator.normal import add_rows
from continuum_loc.estimator.state import ends_in_time, rows_in_time
from continuum_loc.measurements import ImuSample
import numpy as np

STANDARD_GRAVITY = 9.80665  # [m/s^2]


class Row(NamedTuple):
    """One sample: specific force (3,) in the node's frame [m/s^2]."""

    node: int
    force: np.ndarray


class Batch(NamedTuple):
    times: np.ndarray
    nodes: np.ndarray
    force: np.ndarray


class GravityFactor(Factor):
    """Specific force at a node, used only where its length is near that of gravity."""

    name = 'gravity'
    consumes = ImuSample
    batch = Batch

    def __init__(self, setup):
        super().__init__(setup)
        up = np.array(self.settings.gravity.up)
        self._weight = self.settings.gravity.sigma**-2.0
        self._up = STANDARD_GRAVITY * up / np.linalg.norm(up)
        self._imus = {
            imu.name: (
                self.grid.node_at(self.robot.sensor_arclength(imu.name)),
                imu.mount.T_ring_sensor[:3, :3],
            )
            for imu in self.robot.imu
        }

    def row(self, measurement: ImuSample) -> Row:
        node, R_ring_imu = known_sensor(self._imus, measurement.sensor, 'IMU')
        require_finite(measurement.linear_acceleration, 'specific force', measurement.sensor)
        excess = abs(np.linalg.norm(measurement.linear_acceleration) - STANDARD_GRAVITY)
        if excess > self.settings.gravity.gate:
            raise MeasurementError(
                'moving', f"specific force of '{measurement.sensor}' is {excess:.2f} m/s^2 off g"
            )
        return Row(node, R_ring_imu @ measurement.linear_acceleration)

    def linearise(self, batch, a, b, normal):
        squared = _add(normal, a, b, batch, self._up, self._weight, self._work)
        return FactorReport(0.5 * squared, squared, 3 * len(batch.times))


@kernel
def _add(normal, a, b, batch, up, weight, work):
    """Add the samples; returns the sum of weighted squared residuals."""
    index, weights, J = np.empty(24, np.int64), np.full(3, weight), np.empty((3, 24))
    e, turn, ad = np.empty(3), np.zeros(6), np.empty((6, 6))
    squared = 0.0
    for m in range(batch.times.shape[0]):
        gp.relate(ends_in_time(a, b, batch.nodes[m]), work)
        gp.evaluate(work, batch.times[m], True, 6)
        at = work[0]
        for i in range(3):
            turn[3 + i] = at.T[0, i] * up[0] + at.T[1, i] * up[1] + at.T[2, i] * up[2]
            e[i] = turn[3 + i] - batch.force[m, i]
        lie_kernels.ad(turn, ad)
        for i in range(3):
            for j in range(24):
                J[i, j] = 0.0
                for k in range(3):
                    J[i, j] += ad[i, k] * at.J_pose[3 + k, j]
        rows_in_time(batch.nodes[m], normal.g.shape[0] // 2, index)
        squared += add_rows(normal, index, e, J, weights)
    return squared
