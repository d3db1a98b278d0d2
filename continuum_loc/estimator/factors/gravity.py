"""
Accelerometer as gravity's direction: R^T g_up + noise, while the motion is quasi-static.

A body-frame observation of a known map vector; e = R^T up |g| - f, de/dphi = hat(R^T up |g|).
"""

from __future__ import annotations

from continuum_loc import lie_kernels
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, known_sensor, require_finite
from continuum_loc.estimator.state import VELOCITY
from continuum_loc.measurements import ImuSample
from numba import njit
import numpy as np

STANDARD_GRAVITY = 9.80665  # [m/s^2]


class GravityFactor(Factor):
    """Specific force at a node, used only where its length is near that of gravity."""

    name = 'gravity'
    consumes = ImuSample

    def __init__(self, robot, grid, settings):
        super().__init__(robot, grid, settings)
        up = np.array(settings.gravity.up)
        self._up = STANDARD_GRAVITY * up / np.linalg.norm(up)
        self._imus = {
            imu.name: (
                grid.node_at(robot.sensor_arclength(imu.name)),
                imu.mount.T_ring_sensor[:3, :3],
            )
            for imu in robot.imu
        }

    def row(self, measurement: ImuSample) -> tuple:
        node, R_ring_imu = known_sensor(self._imus, measurement.sensor, 'IMU')
        require_finite(measurement.linear_acceleration, 'specific force', measurement.sensor)
        excess = abs(np.linalg.norm(measurement.linear_acceleration) - STANDARD_GRAVITY)
        if excess > self.settings.gravity.gate:
            raise MeasurementError(
                'moving', f"specific force of '{measurement.sensor}' is {excess:.2f} m/s^2 off g"
            )
        return node, R_ring_imu @ measurement.linear_acceleration

    def stack(self, times, rows):
        return times, np.array([row[0] for row in rows]), np.array([row[1] for row in rows])

    def linearise(self, batch, a, b, blocks):
        times, nodes, force = batch
        squared = add_vectors(
            blocks.H,
            blocks.g,
            a.T,
            a.velocity,
            b.T,
            b.velocity,
            b.time - a.time,
            times,
            nodes,
            force,
            self._up,
            self.settings.gravity.sigma**-2.0,
        )
        return FactorReport(0.5 * squared, squared, 3 * len(times))


@njit(cache=True)
def add_vectors(H, g, T_a, v_a, T_b, v_b, dt, times, nodes, measured, map_vector, weight):
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((6, 24)), np.empty((6, 24))
    index, J, e, b, weights = (
        np.empty(24, np.int64),
        np.empty((3, 24)),
        np.empty(3),
        np.empty(6),
        np.full(3, weight),
    )
    size = H.shape[0] // 2
    squared = 0.0
    for m in range(times.shape[0]):
        n = nodes[m]
        gp.hermite(
            T_a[n], v_a[n], T_b[n], v_b[n], dt, times[m], T, v, J_pose, J_rate, W, V, M, J_work
        )
        b[:] = 0.0
        for i in range(3):
            b[3 + i] = T[0, i] * map_vector[0] + T[1, i] * map_vector[1] + T[2, i] * map_vector[2]
            e[i] = b[3 + i] - measured[m, i]
        lie_kernels.ad(b, W[0])
        for i in range(3):
            for j in range(24):
                J[i, j] = 0.0
                for k in range(3):
                    J[i, j] += W[0, i, k] * J_pose[3 + k, j]
        gp.time_index(n, VELOCITY, size, index)
        squared += gp.add_rows(H, g, index, e, J, weights)
    return squared
