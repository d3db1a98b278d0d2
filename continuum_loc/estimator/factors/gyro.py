"""Gyro: omega_measured = R_body_imu^T (varpi_angular + bias) + noise, bias in the body frame."""

from __future__ import annotations

from continuum_loc import lie_kernels
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import (
    Factor,
    FactorReport,
    known_sensor,
    MeasurementError,
    Repeats,
    require_finite,
)
from continuum_loc.estimator.state import VELOCITY
from continuum_loc.measurements import ImuSample
from numba import njit
import numpy as np

# An IMU fits while its mean residual is below four sigmas of one sample; rattling averages out.
FIT_SQUARED = 16.0
MOST_REPEATS = 20  # a real gyro at rest repeats a sample now and then, through its quantisation


class GyroFactor(Factor):
    """Angular velocity at a node, with a bias for each IMU."""

    name = 'gyro'
    consumes = ImuSample

    def __init__(self, robot, grid, settings):
        super().__init__(robot, grid, settings)
        self._repeats = Repeats(MOST_REPEATS)
        self._imus = {
            imu.name: (
                number,
                grid.node_at(robot.sensor_arclength(imu.name)),
                imu.mount.T_ring_sensor[:3, :3],
            )
            for number, imu in enumerate(robot.imu)
        }
        self._weight = (settings.gyro.scale * robot.imu_model.gyro_sigma) ** -2.0

    def row(self, measurement: ImuSample) -> tuple:
        number, node, R_ring_imu = known_sensor(self._imus, measurement.sensor, 'IMU')
        require_finite(measurement.angular_velocity, 'angular velocity', measurement.sensor)
        if np.max(np.abs(measurement.angular_velocity)) > self.robot.imu_model.gyro_range:
            raise MeasurementError(
                'saturated',
                f"gyro '{measurement.sensor}' beyond its full scale of "
                f'{self.robot.imu_model.gyro_range} rad/s',
            )
        if self._repeats.frozen(measurement.sensor, measurement.angular_velocity):
            raise MeasurementError(
                'frozen', f"gyro '{measurement.sensor}' repeats itself to the last bit"
            )
        return number, node, R_ring_imu @ measurement.angular_velocity

    def stack(self, times, rows):
        return (
            times,
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]),
        )

    def linearise(self, batch, a, b, blocks):
        times, imus, nodes, omega = batch
        fits = np.zeros((len(self._imus), 2))
        cost, squared = _add(
            blocks.H,
            blocks.g,
            a.T,
            a.velocity,
            b.T,
            b.velocity,
            a.bias,
            b.time - a.time,
            times,
            nodes,
            imus,
            omega,
            self._weight,
            self.settings.gyro.cauchy,
            self.grid.bias_offset,
            fits,
        )
        return FactorReport(
            cost, squared, 3 * len(times), dict(zip(self._imus, fits, strict=True))
        )


@njit(cache=True)
def _add(
    H,
    g,
    T_a,
    v_a,
    T_b,
    v_b,
    bias,
    dt,
    times,
    nodes,
    imus,
    omega,
    weight,
    cauchy,
    bias_offset,
    fits,
):
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((6, 24)), np.empty((6, 24))
    J, index, e, weights = np.zeros((3, 27)), np.empty(27, np.int64), np.empty(3), np.empty(3)
    size = H.shape[0] // 2
    cost, squared = 0.0, 0.0
    means = np.zeros((fits.shape[0], 3))
    for m in range(times.shape[0]):
        n = nodes[m]
        gp.hermite(
            T_a[n], v_a[n], T_b[n], v_b[n], dt, times[m], T, v, J_pose, J_rate, W, V, M, J_work
        )
        gp.time_index(n, VELOCITY, size, index)
        u2 = 0.0
        for i in range(3):
            e[i] = v[3 + i] + bias[imus[m], i] - omega[m, i]
            u2 += weight * e[i] * e[i]
            index[24 + i] = bias_offset + 3 * imus[m] + i
            for j in range(24):
                J[i, j] = J_rate[3 + i, j]
            J[i, 24 + i] = 1.0
        robust = 1.0 / (1.0 + u2 / (cauchy * cauchy))
        for i in range(3):
            weights[i] = weight * robust
        gp.add_rows(H, g, index, e, J, weights)
        fits[imus[m], 0] += 1.0
        for i in range(3):
            means[imus[m], i] += e[i]
        cost += 0.5 * cauchy * cauchy * np.log1p(u2 / (cauchy * cauchy))
        squared += u2 * robust
    for imu in range(fits.shape[0]):
        mean2 = np.sum(means[imu] ** 2) / max(fits[imu, 0], 1.0) ** 2
        fits[imu, 1] = fits[imu, 0] if mean2 * weight < FIT_SQUARED else 0.0
    return cost, squared
