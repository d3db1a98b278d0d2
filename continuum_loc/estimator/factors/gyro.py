"""Gyro: omega_measured = R_body_imu^T (varpi_angular + bias) + noise, bias in the body frame."""

from __future__ import annotations

from continuum_loc import lie_kernels
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import (
    ClockScores,
    Factor,
    FactorReport,
    known_sensor,
    Repeats,
    require_finite,
)
from continuum_loc.estimator.state import VELOCITY
from continuum_loc.measurements import ImuSample
from numba import njit
import numpy as np

# An IMU fits while its mean residual is below four sigmas of one sample; rattling averages out.
LEAST_RATTLE = 3  # samples that an angle's variance takes
RATTLE_SQUARED = 9.0  # three standard deviations of its angle
CLOCK_STEP = 0.004  # [s] for the slope of the rate
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
        self.weights = dict.fromkeys(self._imus, 1.0)
        self._weight = (settings.gyro.scale * robot.imu_model.gyro_sigma) ** -2.0

    def row(self, measurement: ImuSample) -> tuple:
        number, node, R_ring_imu = known_sensor(self._imus, measurement.sensor, 'IMU')
        if not np.abs(measurement.angular_velocity).max() <= self.robot.imu_model.gyro_range:
            require_finite(measurement.angular_velocity, 'angular velocity', measurement.sensor)
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
        imus, nodes, omega = (np.array([row[i] for row in rows]) for i in range(3))
        order = np.lexsort((times, imus))  # `judge` integrates, whatever came late
        return times[order], imus[order], nodes[order], omega[order]

    def linearise(self, batch, a, b, blocks):
        times, imus, nodes, omega = batch
        residuals = np.empty((len(times), 3))
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
            self._shares(),
            self.settings.gyro.cauchy,
            self.grid.bias_offset,
            residuals,
        )
        fits, rattle = self._judge(times, imus, residuals)
        return FactorReport(cost, squared, 3 * len(times), fits, rattle)

    def _shares(self) -> np.ndarray:
        return np.array(list(self.weights.values()))

    def clock_scores(self, batch, a, b):
        times, imus, nodes, omega = batch
        number = len(self._imus)
        gradient, information, squared = np.zeros((3, number))
        coupling = np.zeros((2 * self.grid.dim, number))
        _add_clocks(
            gradient,
            information,
            coupling,
            squared,
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
            self.grid.bias_offset,
        )
        samples = np.maximum(np.bincount(imus, minlength=number), 1)
        spread = self._weight * squared / (3.0 * samples)
        robust = self._weight / (1.0 + spread / self.settings.gyro.cauchy**2)
        weight = robust * self._shares()
        # What no offset explains of the rates may be more than noise: a body that rattles.
        unexplained = squared - gradient**2 / np.maximum(information, 1e-12)
        return ClockScores(
            list(self._imus),
            weight * gradient,
            weight * information,
            weight * coupling,
            robust * unexplained / (3.0 * samples),
        )

    def _judge(
        self, times: np.ndarray, imus: np.ndarray, residuals: np.ndarray
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Count [usable, fitting] samples by IMU, and take the variance (3,) of its rattle."""
        fits, rattle = np.zeros((len(self._imus), 2)), np.zeros((len(self._imus), 3))
        judge(times, imus, residuals, self._weight, fits, rattle)
        heard = [(number, name) for number, name in enumerate(self._imus) if fits[number, 0] > 0.0]
        return {name: fits[n] for n, name in heard}, {name: rattle[n] for n, name in heard}


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
    shares,
    cauchy,
    bias_offset,
    residuals,
):
    """
    Add the samples; returns the robust cost and the sum of weighted squared residuals.

    The Cauchy loss is on all samples of an IMU at once: where the body moves faster than a cubic
    between two knots can, their residuals are no white noise of the gyro, and all of them count
    less. A loss on each sample would take the largest rates for outliers and bias their mean.
    """
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((0, 24)), np.empty((3, 24))
    J, index = np.zeros((3, 27)), np.empty(27, np.int64)
    H_imu, g_imu = np.zeros((27, 27)), np.zeros(27)
    size, c2 = H.shape[0] // 2, cauchy * cauchy
    cost, squared, related = 0.0, 0.0, -1
    misfit, samples = 0.0, 0
    for i in range(3):
        J[i, 12 + i] = 1.0  # of the bias, which stands between the two columns' parts
    for m in range(times.shape[0]):
        n, imu = nodes[m], imus[m]
        if n != related:  # samples of an IMU come after one another
            gp.relate(T_a[n], T_b[n], v_b[n], W, V, M)
            related = n
        gp.evaluate(T_a[n], v_a[n], dt, times[m], T, v, J_pose, J_rate, W, V, M, J_work)
        for i in range(3):
            residuals[m, i] = v[3 + i] + bias[imu, i] - omega[m, i]
            misfit += weight * residuals[m, i] * residuals[m, i]
            for j in range(12):
                J[i, j], J[i, 15 + j] = J_rate[i, j], J_rate[i, 12 + j]
        gp.gather_rows(H_imu, g_imu, residuals[m], J)
        samples += 1
        if m + 1 < times.shape[0] and imus[m + 1] == imu:
            continue
        spread = misfit / (3.0 * samples)
        robust = 1.0 / (1.0 + spread / c2)
        cost += 0.5 * shares[imu] * 3.0 * samples * c2 * np.log1p(spread / c2)
        squared += misfit * robust
        gp.time_index(n, VELOCITY, size, index)
        index[15:] = index[12:24].copy()
        for i in range(3):
            index[12 + i] = bias_offset + 3 * imu + i
        gp.scatter(H, g, index, H_imu, g_imu, shares[imu] * weight * robust)
        misfit, samples = 0.0, 0
    return cost, squared


@njit(cache=True)
def _add_clocks(
    gradient,
    information,
    coupling,
    squared,
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
    bias_offset,
):
    """Add each sample's slope, information and coupling; the slope is the angular acceleration."""
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((0, 24)), np.empty((3, 24))
    before, after, index = np.empty(6), np.empty(6), np.empty(24, np.int64)
    related = -1
    for m in range(times.shape[0]):
        n, imu = nodes[m], imus[m]
        if n != related:  # samples of an IMU come after one another
            gp.relate(T_a[n], T_b[n], v_b[n], W, V, M)
            gp.time_index(n, VELOCITY, coupling.shape[0] // 2, index)
            related = n
        t0, t1 = max(times[m] - CLOCK_STEP, 0.0), min(times[m] + CLOCK_STEP, dt)
        gp.rate_at(v_a[n], dt, t0, before, W, V)
        gp.rate_at(v_a[n], dt, t1, after, W, V)
        gp.evaluate(T_a[n], v_a[n], dt, times[m], T, v, J_pose, J_rate, W, V, M, J_work)
        for i in range(3, 6):
            slope = (after[i] - before[i]) / (t1 - t0)
            error = v[i] + bias[imu, i - 3] - omega[m, i - 3]
            squared[imu] += error * error
            gradient[imu] += slope * error
            information[imu] += slope * slope
            coupling[bias_offset + 3 * imu + i - 3, imu] += slope
            for j in range(24):
                coupling[index[j], imu] += slope * J_rate[i - 3, j]


@njit(cache=True)
def judge(times, imus, residuals, weight, fits, rattle):
    """
    Write [usable, fitting] samples and the variance (3,) of the rattle's angle, by IMU.

    The angle is what residual rates (M, 3) at increasing times (M,) integrate to [rad]; white
    noise of the gyro alone makes it a random walk of variance T / 6 about its mean, taken off.
    """
    number = fits.shape[0]
    first, last, before = np.zeros(number), np.zeros(number), np.zeros((number, 3))
    angle, mean = np.zeros((number, 3)), np.zeros((number, 3))
    total, squares = np.zeros((number, 3)), np.zeros((number, 3))
    for m in range(times.shape[0]):
        n = imus[m]
        if fits[n, 0] == 0.0:
            first[n] = times[m]
        for i in range(3):
            if fits[n, 0] > 0.0:
                step = times[m] - last[n]
                angle[n, i] += 0.5 * step * (residuals[m, i] + before[n, i])
            before[n, i] = residuals[m, i]
            mean[n, i] += residuals[m, i]
            total[n, i] += angle[n, i]
            squares[n, i] += angle[n, i] * angle[n, i]
        last[n] = times[m]
        fits[n, 0] += 1.0
    for n in range(number):
        count = fits[n, 0]
        if count == 0.0:
            continue
        span = last[n] - first[n]
        mean2, rattled = 0.0, 0.0
        for i in range(3):
            mean2 += (mean[n, i] / count) ** 2
            if count >= LEAST_RATTLE:
                walk = span * span / (count - 1.0) / (6.0 * weight)
                spread = squares[n, i] / count - (total[n, i] / count) ** 2
                rattle[n, i] = max(spread - walk, 0.0)
            rattled += rattle[n, i]
        # A rattle that ends within the interval leaves a mean rate too.
        allowed = FIT_SQUARED / weight + RATTLE_SQUARED * rattled / max(span, 1e-3) ** 2
        fits[n, 1] = count if mean2 < allowed else 0.0
