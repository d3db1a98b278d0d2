"""Gyro: omega_measured = R_body_imu^T (varpi_angular + bias) + noise, bias in the body frame."""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.compiling import kernel
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
from continuum_loc.estimator.normal import gather_rows, new_normal, scatter
from continuum_loc.estimator.state import ends_in_time, NODE_DIM, rows_in_time
from continuum_loc.estimator.tolerance import GYRO_AXES, GYRO_SCALE
from continuum_loc.measurements import ImuSample
import numpy as np

# An IMU fits while its mean residual is below four sigmas of one sample; rattling averages out.
FIT_SQUARED = 16.0
LEAST_RATTLE = 3  # samples that an angle's variance takes
RATTLE_SQUARED = 9.0  # three standard deviations of its angle
CLOCK_STEP = 0.004  # [s] for the slope of the rate
MOST_REPEATS = 20  # a real gyro at rest repeats a sample now and then, through its quantisation


class Row(NamedTuple):
    """One sample: angular velocity (3,) in the node's frame [rad/s]."""

    imu: int
    node: int
    omega: np.ndarray


class Batch(NamedTuple):
    times: np.ndarray
    imus: np.ndarray
    nodes: np.ndarray
    omega: np.ndarray


class Noise(NamedTuple):
    """One over a sample's variance, what each IMU's count by, and the scale of the loss."""

    weight: float
    shares: np.ndarray
    cauchy: float


class GyroFactor(Factor):
    """Angular velocity at a node, with a bias for each IMU."""

    name = 'gyro'
    consumes = ImuSample
    batch = Batch
    tolerances = np.array([GYRO_AXES, GYRO_AXES, GYRO_AXES, GYRO_SCALE])

    def __init__(self, setup):
        super().__init__(setup, [imu.name for imu in setup.robot.imu])
        self._repeats = Repeats(MOST_REPEATS)
        self._imus = {
            imu.name: (
                number,
                self.grid.node_at(self.robot.sensor_arclength(imu.name)),
                imu.mount.T_ring_sensor[:3, :3],
            )
            for number, imu in enumerate(self.robot.imu)
        }
        sigma = self.settings.gyro.scale * self.robot.imu_model.gyro_sigma
        self.information = sigma**-2.0

    def row(self, measurement: ImuSample) -> Row:
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
        return Row(number, node, R_ring_imu @ measurement.angular_velocity)

    def stack(self, times, rows):
        order = np.lexsort((times, [row.imu for row in rows]))  # `judge` integrates
        return super().stack(times[order], [rows[m] for m in order])

    def linearise(self, batch, a, b, normal):
        residuals = np.empty((len(batch.times), 3))
        noise = Noise(self.information, self.weights, self.settings.gyro.cauchy)
        cost, squared = _add(normal, a, b, batch, noise, residuals, self._work)
        fits, rattle = np.zeros((len(self.sensors), 2)), np.full((len(self.sensors), 3), np.nan)
        judge(batch.times, batch.imus, residuals, self.information, fits, rattle)
        return FactorReport(cost, squared, residuals.size, fits, rattle)

    def bordered(self, batch, a, b, border, of):
        columns = np.hstack(
            [of.columns(kind, self.sensors) for kind in ('gyro', 'clock', 'delay')]
        )
        noise = Noise(self.information, self.weights, self.settings.gyro.cauchy)
        _add_border(border, a, b, batch, noise, columns, self._work)

    def clock_scores(self, batch, a, b):
        scores = ClockScores.zeros(len(self.sensors), 1 + len(self.tolerances), self.grid.dim)
        _add_clocks(scores, a, b, batch, self._work)
        gradient, information, coupling, squared = scores
        samples = 3.0 * np.maximum(np.bincount(batch.imus, minlength=len(self.sensors)), 1)
        spread = self.information * squared / samples
        robust = self.information / (1.0 + spread / self.settings.gyro.cauchy**2)
        weight = robust * self.weights
        # What no offset explains of the rates may be more than noise: a body that rattles.
        explained = gradient[:, 0] ** 2 / np.maximum(information[:, 0, 0], 1e-12)
        return ClockScores(
            weight[:, None] * gradient,
            weight[:, None, None] * information,
            weight[:, None] * coupling,
            robust * (squared - explained) / samples,
        )


@kernel
def _add(normal, a, b, batch, noise, residuals, work):
    """
    Add the samples; returns the robust cost and the sum of weighted squared residuals.

    The Cauchy loss is on all samples of an IMU at once: where the body moves faster than a cubic
    between two knots can, their residuals are no white noise of the gyro, and all of them count
    less. A loss on each sample would take the largest rates for outliers and bias their mean.
    """
    J, total, index = np.zeros((3, 27)), new_normal(27), np.empty(27, np.int64)
    c2 = noise.cauchy * noise.cauchy
    cost, squared, related = 0.0, 0.0, -1
    misfit, samples = 0.0, 0
    for i in range(3):
        J[i, 12 + i] = 1.0  # of the bias, which stands between the two columns' parts
    for m in range(batch.times.shape[0]):
        n, imu = batch.nodes[m], batch.imus[m]
        if n != related:  # samples of an IMU come after one another
            gp.relate(ends_in_time(a, b, n), work)
            related = n
        gp.evaluate(work, batch.times[m], False, 3)
        at = work[0]
        for i in range(3):
            residuals[m, i] = at.v[3 + i] + a.bias[imu, i] - batch.omega[m, i]
            misfit += noise.weight * residuals[m, i] * residuals[m, i]
            for j in range(12):
                J[i, j], J[i, 15 + j] = at.J_rate[3 + i, j], at.J_rate[3 + i, 12 + j]
        gather_rows(total, residuals[m], J)
        samples += 1
        if m + 1 < batch.times.shape[0] and batch.imus[m + 1] == imu:
            continue
        spread = misfit / (3.0 * samples)
        robust = 1.0 / (1.0 + spread / c2)
        cost += 0.5 * noise.shares[imu] * 3.0 * samples * c2 * np.log1p(spread / c2)
        squared += misfit * robust
        _rows_with_bias(a, n, imu, normal.g.shape[0] // 2, index)
        scatter(normal, index, total, noise.shares[imu] * noise.weight * robust)
        misfit, samples = 0.0, 0
    return cost, squared


@kernel
def _add_border(border, a, b, batch, noise, columns, work):
    """Add what the samples say of axes and clock of their gyros, weighed as in `_add`."""
    first, count = 0, batch.times.shape[0]
    for m in range(count):
        if m + 1 < count and batch.imus[m + 1] == batch.imus[m]:
            continue
        imu = batch.imus[m]
        gp.relate(ends_in_time(a, b, batch.nodes[m]), work)
        squared = 0.0
        for k in range(first, m + 1):
            gp.rate_at(work, batch.times[k])
            for i in range(3):
                squared += (work[0].v[3 + i] + a.bias[imu, i] - batch.omega[k, i]) ** 2
        spread = noise.weight * squared / (3.0 * (m + 1 - first))
        robust = 1.0 / (1.0 + spread / (noise.cauchy * noise.cauchy))
        information = noise.shares[imu] * noise.weight * robust
        for k in range(first, m + 1):
            _add_sample(border, a, b, batch, k, information, columns[imu], work)
        first = m + 1


@kernel
def _add_sample(border, a, b, batch, m, information, columns, work):
    """Add one sample, whose node `relate` left in the workspace."""
    n, imu, time = batch.nodes[m], batch.imus[m], batch.times[m]
    slope, index, J, D = np.empty(3), np.empty(27, np.int64), np.zeros(27), np.zeros(11)
    _rows_with_bias(a, n, imu, border.C.shape[0] // 2, index)
    _acceleration(work, time, b.time - a.time, slope)
    gp.evaluate(work, time, False, 3)
    at = work[0]
    for i in range(3):
        error = at.v[3 + i] + a.bias[imu, i] - batch.omega[m, i]
        J[12:15] = 0.0
        J[12 + i] = 1.0
        for j in range(12):
            J[j], J[15 + j] = at.J_rate[3 + i, j], at.J_rate[3 + i, 12 + j]
        D[:] = 0.0
        for j in range(3):
            D[3 * i + j] = -batch.omega[m, j]
        D[9] = D[10] = slope[i]
        for p in range(11):
            if columns[p] < 0 or D[p] == 0.0:
                continue
            weighted = information * D[p]
            border.g[columns[p]] += weighted * error
            for q in range(11):
                if columns[q] >= 0:
                    border.H[columns[p], columns[q]] += weighted * D[q]
            for j in range(27):
                border.C[index[j], columns[p]] += weighted * J[j]


@kernel
def _rows_with_bias(column, n, imu, dim, index):
    """Rows (27,) of a node at two knots of `dim` each, with the older knot's bias between them."""
    biases = NODE_DIM * column.T.shape[0]
    rows_in_time(n, dim, index)
    index[15:] = index[12:24].copy()
    for i in range(3):
        index[12 + i] = biases + 3 * imu + i


@kernel
def _add_clocks(scores, a, b, batch, work):
    """
    Add what each sample says of its gyro's clock, axes and scale; its squared error as `spread`.

    The rate w changes by X = [dw/dt, [w]x, w] with them.
    """
    X, JX, index, related = np.zeros((3, 5)), np.empty((24, 5)), np.empty(24, np.int64), -1
    biases, dt = NODE_DIM * a.T.shape[0], b.time - a.time
    error, slope = np.empty(3), np.empty(3)
    for m in range(batch.times.shape[0]):
        n, imu, time = batch.nodes[m], batch.imus[m], batch.times[m]
        if n != related:  # samples of an IMU come after one another
            gp.relate(ends_in_time(a, b, n), work)
            rows_in_time(n, scores.coupling.shape[0] // 2, index)
            related = n
        _acceleration(work, time, dt, slope)
        gp.evaluate(work, time, False, 3)
        at = work[0]
        _rate_changes(slope, at.v, X)
        for i in range(3):
            error[i] = at.v[3 + i] + a.bias[imu, i] - batch.omega[m, i]
            scores.spread[imu] += error[i] * error[i]
            scores.coupling[biases + 3 * imu + i, imu] += X[i]
        scores.gradient[imu] += X.T @ error
        scores.information[imu] += X.T @ X
        JX[:, :] = at.J_rate[3:].T @ X
        for j in range(24):
            scores.coupling[index[j], imu] += JX[j]


@kernel
def _rate_changes(slope, v, X):
    """Write X (3, 5) of `_add_clocks` at the velocity v (6,)."""
    X[:, 0] = slope
    X[:, 4] = v[3:]
    X[0, 2], X[0, 3] = -v[5], v[4]
    X[1, 1], X[1, 3] = v[5], -v[3]
    X[2, 1], X[2, 2] = -v[4], v[3]


@kernel
def _acceleration(work, time, dt, slope):
    """Write the angular acceleration (3,) at `time`: a difference over CLOCK_STEP either way."""
    t0, t1 = max(time - CLOCK_STEP, 0.0), min(time + CLOCK_STEP, dt)
    gp.rate_at(work, t0)
    slope[:] = work[0].v[3:]
    gp.rate_at(work, t1)
    for i in range(3):
        slope[i] = (work[0].v[3 + i] - slope[i]) / (t1 - t0)


@kernel
def judge(times, imus, residuals, information, fits, rattle):
    """
    Write [usable, fitting] samples and the variance (3,) of the rattle's angle, by IMU.

    The angle is what residual rates (M, 3) at increasing times (M,) of an IMU integrate to [rad];
    white noise of the gyro alone makes it a random walk of variance T / 6 about its mean, taken
    off. An IMU without samples keeps the rattle that it came with.
    """
    first = 0
    for m in range(times.shape[0]):
        if m + 1 == times.shape[0] or imus[m + 1] != imus[m]:
            own = slice(first, m + 1)
            fits[imus[m], 0] = m + 1 - first
            fitting = _judge_imu(times[own], residuals[own], information, rattle[imus[m]])
            fits[imus[m], 1] = m + 1 - first if fitting else 0.0
            first = m + 1


@kernel
def _judge_imu(times, residuals, information, rattle):
    """Write the variance (3,) of one IMU's rattle; whether its mean residual is small enough."""
    count, span = times.shape[0], times[-1] - times[0]
    walk = span * span / max(count - 1.0, 1.0) / (6.0 * information)
    mean2, rattled = 0.0, 0.0
    for i in range(3):
        angle, total, squares, sum_ = 0.0, 0.0, 0.0, 0.0
        for m in range(count):
            if m > 0:
                step = times[m] - times[m - 1]
                angle += 0.5 * step * (residuals[m, i] + residuals[m - 1, i])
            sum_ += residuals[m, i]
            total += angle
            squares += angle * angle
        mean2 += (sum_ / count) ** 2
        spread = squares / count - (total / count) ** 2
        rattle[i] = max(spread - walk, 0.0) if count >= LEAST_RATTLE else 0.0
        rattled += rattle[i]
    # A rattle that ends within the interval leaves a mean rate too.
    return mean2 < FIT_SQUARED / information + RATTLE_SQUARED * rattled / max(span, 1e-3) ** 2
