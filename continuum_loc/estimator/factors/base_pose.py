"""
Measured pose of a carried base: an arm's kinematics, a vehicle's odometry, a tracker.

Its samples are poses M of the base at zero insertion in a frame that may lie otherwise in `map`
than it should: C = T_map_frame is part of the state. With the travel x of the encoder at the same
instant the first node is at C M Exp(x), so that

    e = Log((C M Exp(x))^-1 T),  de/dT = J_r(e)^-1,  de/dC = -J_l(e)^-1 Ad((M Exp(x))^-1).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from continuum_loc import lie, lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import Factor, FactorReport, require_finite
from continuum_loc.estimator.factors.pose import FIT_SQUARED, LEAST_WEIGHT, travel_of
from continuum_loc.estimator.normal import add_rows
from continuum_loc.estimator.state import ends_in_time, frame_row, rows_in_time
from continuum_loc.measurements import BaseSample, EncoderSample
import numpy as np

ALONG = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
UNKNOWN_TRAVEL = 1e3  # [m]
KEPT = 3  # travels before an interval, from which the first of it is interpolated


class Row(NamedTuple):
    """
    One sample: where the base is told to be, or how far it is inserted.

    T_frame_base (4, 4), covariance (6, 6), and a travel that is nan; or the travel [m] alone.
    """

    T_frame_base: np.ndarray
    covariance: np.ndarray
    travel: float
    stamp: int


class Batch(NamedTuple):
    """Poses of the first node in the frame (M, 4, 4), and roots (M, 6, 6) of their information."""

    times: np.ndarray
    T_frame_node: np.ndarray
    roots: np.ndarray


class Loss(NamedTuple):
    """Scale of the Cauchy loss, what the base's measurement counts by, its [usable, fitting]."""

    cauchy: float
    weights: np.ndarray
    fits: np.ndarray


class BasePoseFactor(Factor):
    """Where a carried base is, and how far it is inserted."""

    name = 'base'
    consumes = (BaseSample, EncoderSample)
    batch = Batch

    def __init__(self, setup):
        super().__init__(setup, ['base'])
        base = self.robot.base
        self._insertion, self._latency = base.insertion, base.measurement.latency
        self._encoded = self._insertion.mode == 'measured'
        self.consumes = (BaseSample, EncoderSample) if self._encoded else (BaseSample,)
        turn = np.radians(base.measurement.sigma_rotation_deg)
        sigma = np.array([base.measurement.sigma_position] * 3 + [turn] * 3)
        self._default = np.diag(np.square(sigma))
        self._travels: deque[tuple[int, float]] = deque(maxlen=KEPT)
        self._first: Row | None = None

    @classmethod
    def wanted(cls, setup):
        return setup.robot.base.mode == 'measured' and super().wanted(setup)

    def row(self, measurement: BaseSample | EncoderSample) -> Row:
        if isinstance(measurement, EncoderSample):
            travel = travel_of(measurement, self._insertion)
            self._travels.append((measurement.stamp, travel))
            return Row(np.eye(4), self._default, travel, measurement.stamp)
        require_finite(measurement.T_frame_base, 'pose', 'base')
        covariance = self._default
        if np.any(measurement.covariance):
            covariance = measurement.covariance
            if np.linalg.eigvalsh(covariance)[0] <= 0.0:
                raise MeasurementError('bad covariance', 'that of the base is not positive')
        row = Row(measurement.T_frame_base, covariance, np.nan, measurement.stamp)
        self._first = self._first or row
        return row

    def lateness(self, measurement):
        return self._latency if isinstance(measurement, BaseSample) else 0.0

    def stack(self, times, rows):
        told = np.array([np.isnan(row.travel) for row in rows])
        poses = [row for row, is_pose in zip(rows, told, strict=True) if is_pose]
        if not poses:
            return Batch(np.empty(0), np.empty((0, 4, 4)), np.empty((0, 6, 6)))
        travels = self._travels_at(poses, rows)
        along = lie.exp(travels[:, None] * ALONG)
        Ad = lie.adjoint(lie.inverse(along))
        covariance = Ad @ np.array([row.covariance for row in poses]) @ np.swapaxes(Ad, 1, 2)
        encoders = np.count_nonzero(~told)
        if encoders:  # several poses share an encoder's error
            covariance[:, 0, 0] += self._insertion.sigma**2 * max(len(poses) / encoders, 1.0)
        roots = np.swapaxes(np.linalg.cholesky(self._informed(covariance)), 1, 2)
        return Batch(times[told], np.array([row.T_frame_base for row in poses]) @ along, roots)

    def _travels_at(self, poses: list[Row], rows: list[Row]) -> np.ndarray:
        """Travel [m] at each pose: between two encoders' samples, or as the last ones run on."""
        if not self._encoded:
            return np.full(len(poses), np.mean(self._insertion.range))
        known = {row.stamp: row.travel for row in rows if not np.isnan(row.travel)}
        known |= {stamp: travel for stamp, travel in self._travels if stamp not in known}
        if not known:
            return np.zeros(len(poses))
        stamps = np.array(sorted(known))
        travels = np.array([known[stamp] for stamp in stamps])
        offset = round(1e9 * self._latency)
        at = np.array([row.stamp for row in poses]) - offset - stamps[0]
        return np.interp(at.astype(float), (stamps - stamps[0]).astype(float), travels)

    def _informed(self, covariance: np.ndarray) -> np.ndarray:
        """Information (M, 6, 6); none along a base whose travel is unknown."""
        if self._insertion.mode == 'unknown':
            covariance[:, 0, 0] += UNKNOWN_TRAVEL**2
        return np.linalg.inv(covariance)

    def linearise(self, batch, a, b, normal):
        fits = np.zeros((1, 2))
        loss = Loss(self.settings.base.cauchy, self.weights, fits)
        cost, squared = _add(normal, a, b, batch, loss, self._work)
        return FactorReport(cost, squared, 6 * len(batch.times), fits)

    def weigh(self, doubted, weight):
        return super().weigh(doubted, LEAST_WEIGHT * weight)

    def awaited(self):
        return True

    def needed(self):
        return BaseSample

    def guess(self, row, guess):
        """Begin where the base is told to be; a frame that is not `map` lies so that it fits."""
        travel = self._travels[-1][1] if self._travels else 0.0
        if not self._encoded:
            travel = float(np.mean(self._insertion.range))
        T_frame_node = self._first.T_frame_base @ lie.exp(travel * ALONG)
        measurement = self.robot.base.measurement
        if measurement.frame == 'map' and measurement.drift == 0.0:
            guess.T_map_base = T_frame_node
            return
        guess.T_map_base = self.robot.base.T_map_base @ lie.exp(travel * ALONG)
        guess.T_map_frame = (guess.T_map_base @ lie.inverse(T_frame_node))[None]


@kernel
def _add(normal, a, b, batch, loss, work):
    """Add the poses; returns the robust cost and the sum of weighted squared residuals."""
    at, dim, c2 = work[0], normal.g.shape[0] // 2, loss.cauchy * loss.cauchy
    C_a, step, C, wanted = a.T_map_frame[0], np.empty(6), np.empty((4, 4)), np.empty((4, 4))
    J, index, weights = np.empty((6, 36)), np.empty(36, np.int64), np.empty(6)
    e, whitened, by_frame = np.empty(6), np.empty((6, 36)), np.empty((6, 6))
    lie_kernels.relative(C_a, b.T_map_frame[0], at.scratch.pose)
    lie_kernels.log(at.scratch.pose, step)
    gp.relate(ends_in_time(a, b, 0), work)
    _rows(dim, frame_row(a), index)
    cost, squared, duration = 0.0, 0.0, b.time - a.time
    for m in range(batch.times.shape[0]):
        u = batch.times[m] / duration
        lie_kernels.exp(u * step, wanted)
        lie_kernels.compose(C_a, wanted, C)
        lie_kernels.compose(C, batch.T_frame_node[m], wanted)
        gp.evaluate(work, batch.times[m], True, 6)
        _residual(work, wanted, batch.T_frame_node[m], e, by_frame)
        for i in range(6):
            for j in range(12):
                J[i, j] = J[i, 18 + j] = 0.0
                for k in range(6):
                    J[i, j] += at.right_gamma[i, k] * at.J_pose[k, j]
                    J[i, 18 + j] += at.right_gamma[i, k] * at.J_pose[k, 12 + j]
            for j in range(6):
                J[i, 12 + j], J[i, 30 + j] = (1.0 - u) * by_frame[i, j], u * by_frame[i, j]
        u2 = _whiten(batch.roots[m], e, J, whitened)
        robust = 1.0 / (1.0 + u2 / c2)
        weights[:] = loss.weights[0] * robust
        add_rows(normal, index, e, whitened, weights)
        loss.fits[0, 0] += 1.0
        loss.fits[0, 1] += 1.0 if u2 < FIT_SQUARED else 0.0
        cost += loss.weights[0] * 0.5 * c2 * np.log1p(u2 / c2)
        squared += u2 * robust
    return cost, squared


@kernel
def _rows(dim, frame, index):
    """Write the rows (36,) of the first node and of the frame in an interval's two columns."""
    node = np.empty(24, np.int64)
    rows_in_time(0, dim, node)
    for i in range(12):
        index[i], index[18 + i] = node[i], node[12 + i]
    for i in range(6):
        index[12 + i], index[30 + i] = frame + i, dim + frame + i


@kernel
def _residual(work, T_wanted, T_frame_node, e, by_frame):
    """Write e (6,) and its Jacobian by the frame; that by the pose is left in `right_gamma`."""
    at = work[0]
    gamma, scratch = at.gamma, at.scratch
    lie_kernels.pose_error(T_wanted, at.T, gamma, at.right_gamma, scratch)
    lie_kernels.relative(T_frame_node, np.eye(4), scratch.pose)
    lie_kernels.adjoint(scratch.pose, scratch.matrix)
    for i in range(6):
        e[i] = gamma.x[i]
        for j in range(6):
            by_frame[i, j] = 0.0
            for k in range(6):  # J_l^-1 = J_r^-1 - ad
                left = at.right_gamma[i, k] - gamma.ad[i, k]
                by_frame[i, j] -= left * scratch.matrix[k, j]


@kernel
def _whiten(root, e, J, whitened):
    """Multiply e (6,) and J (6, 36) by an upper root of the information; the squared error."""
    squared = 0.0
    for i in range(6):
        total = 0.0
        whitened[i] = 0.0
        for k in range(i, 6):
            total += root[i, k] * e[k]
            for j in range(36):
                whitened[i, j] += root[i, k] * J[k, j]
        e[i] = total
        squared += total * total
    return squared
