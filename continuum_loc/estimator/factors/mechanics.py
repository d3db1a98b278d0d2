"""
The shape that statics expects of the tendons: a measurement of how each node lies from the last.

From displacements or tensions in `joint_states` the body's equilibrium follows (`mechanics`), and
from it the pose of every node in the frame of the one before. The residual is

    e = Log(T_expected^-1 T_n^-1 T_n+1),

between two knots weighted by how near the sample is to each. Strain that departs from the statics
by `strain_sigma`, all along a segment of length h, has the covariance G S G' with G the
derivative of the relative pose by the strain. What is left out (dynamics, contacts, wrong
stiffness) stays for long, so samples within `memory` count as one.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.compiling import kernel
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator.factors.base import Factor, FactorReport, require_finite
from continuum_loc.estimator.normal import gather, new_normal, Normal, scatter
from continuum_loc.estimator.state import NODE_DIM
from continuum_loc.lie_kernels import adjoint, apply, pose_error, product, relative, SCRATCH, TWIST
from continuum_loc.measurements import EncoderSample, seconds
from continuum_loc.mechanics.body import BodyState, TendonBody
import numpy as np


class Row(NamedTuple):
    """What one sample says: expected poses (N - 1, 4, 4) T_node_next, and what it counts by."""

    T_node_next: np.ndarray
    share: float


class Batch(NamedTuple):
    times: np.ndarray
    T_node_next: np.ndarray  # (R, N - 1, 4, 4)
    share: np.ndarray  # (R,)


class Loss(NamedTuple):
    """Scale of the robust loss, what the factor counts by, and information (N - 1, 6, 6)."""

    cauchy: float
    weight: float
    information: np.ndarray


class MechanicsFactor(Factor):
    """Relative poses of neighbouring nodes, from the statics of the tendons."""

    name = 'mechanics'
    consumes = EncoderSample
    batch = Batch

    def __init__(self, setup):
        super().__init__(setup, ['tendons'])
        self._options = self.settings.mechanics
        self._body = TendonBody(self.robot)
        self._state = BodyState(self._body)
        self._edges = np.concatenate([[0.0], np.cumsum(self._body.rod.spans)])
        self._heard: deque[tuple[int, np.ndarray]] = deque()
        self._used: int | None = None
        self.motors: np.ndarray | None = None  # as they acted last, in the tendons' order
        self.information = self._information()
        self._room = np.zeros(1, TWIST), np.zeros(1, SCRATCH)

    @classmethod
    def wanted(cls, setup):
        return setup.robot.actuation is not None and super().wanted(setup)

    def row(self, measurement: EncoderSample) -> Row:
        motors = self._motors(measurement)
        self._heard.append((measurement.stamp, motors))
        if self._used is not None:
            age = seconds(measurement.stamp, self._used)
            if 0.0 <= age < self._options.period:
                raise MeasurementError('between', 'taken with the next one')
        then = self._delayed(measurement.stamp)
        if not self._state.move(then):
            self._state = BodyState(self._body)
            raise MeasurementError('no equilibrium', f'no static shape for motors at {then}')
        self.motors = then
        passed = self._options.period if self._used is None else abs(age)
        self._used = measurement.stamp
        share = min(passed / self._options.memory, 1.0)
        return Row(self._relative(), share)

    def _motors(self, measurement: EncoderSample) -> np.ndarray:
        """Motors (M,) in the order of the tendons."""
        block = self.robot.actuation
        missing = [name for name in block.names if name not in measurement.names]
        if missing:
            raise MeasurementError(
                'motor missing',
                f'joint_states has no {", ".join(missing)}; it names '
                f'{", ".join(measurement.names)}',
            )
        values = measurement.effort if block.mode == 'tension' else measurement.position
        motors = values[[measurement.names.index(name) for name in block.names]]
        require_finite(motors, block.mode, 'joint_states')
        return motors

    def _delayed(self, stamp: int) -> np.ndarray:
        """Motors as they act at `stamp` [ns]: as they were `delay` before."""
        at = -self.robot.actuation.delay
        while len(self._heard) > 1 and seconds(self._heard[1][0], stamp) <= at:
            self._heard.popleft()
        (first, before), (last, after) = self._heard[0], self._heard[min(1, len(self._heard) - 1)]
        span = seconds(last, first)
        if span <= 0.0:
            return before
        share = np.clip((at - seconds(first, stamp)) / span, 0.0, 1.0)
        return before + share * (after - before)

    def _relative(self) -> np.ndarray:
        """(N - 1, 4, 4) poses of the grid's nodes in the frames of those before, as expected."""
        elements = len(self._body.s)
        at = np.clip(np.searchsorted(self._edges, self.grid.s, side='right') - 1, 0, elements - 1)
        part = (self.grid.s - self._edges[at]) / self._body.rod.spans[at]
        balance = self._state.balance
        T = balance.T[at] @ lie.exp(part[:, None] * balance.twists[at])
        return lie.inverse(T[:-1]) @ T[1:]

    def _information(self) -> np.ndarray:
        """(N - 1, 6, 6) of the expected relative poses, in the frame of the later node."""
        block, backbone = self.robot.actuation, self.robot.backbone
        sigma = np.array(backbone.rest_strain_sigma)
        sigma[[0, 4, 5]] = block.strain_sigma
        sigma *= self._options.scale
        h = np.diff(self.grid.s)
        G = h[:, None, None] * np.eye(6)
        G[:, 1, 5], G[:, 2, 4] = 0.5 * h**2, -0.5 * h**2
        return np.linalg.inv(G * sigma**2 @ G.transpose(0, 2, 1))

    def linearise(self, batch, a, b, normal):
        loss = Loss(self._options.cauchy, self.weights[0], self.information)
        cost, squared = _add(normal, a, b, batch, loss, *self._room)
        return FactorReport(cost, squared, 6 * batch.T_node_next.shape[1] * len(batch.times))

    def awaited(self):
        return True

    def guess(self, row, guess):
        lengths = np.diff(self.grid.s)[:, None]
        between = lie.log(row.T_node_next) / lengths
        guess.strain[1:] = between
        guess.strain[:1] = between[:1]


@kernel
def _add(normal, a, b, batch, loss, twist, scratch):
    """Add the samples; returns the robust cost and the sum of weighted squared residuals."""
    total, local = new_normal(24), Normal(np.zeros((6, 6)), np.zeros(6))
    J, index, room = np.zeros((6, 24)), np.empty(24, np.int64), np.empty((6, 24))
    T, e, dim = np.empty((2, 4, 4)), np.empty(6), normal.g.shape[0] // 2
    cost, squared, c2, span = 0.0, 0.0, loss.cauchy * loss.cauchy, b.time - a.time
    for n in range(loss.information.shape[0]):
        relative(a.T[n], a.T[n + 1], T[0])
        relative(b.T[n], b.T[n + 1], T[1])
        for r in range(batch.times.shape[0]):
            u = batch.times[r] / span
            e[:] = 0.0
            for half in range(2):
                share = u if half else 1.0 - u
                _half(batch.T_node_next[r, n], T[half], share, e, J, 12 * half, twist, scratch)
            apply(loss.information[n], e, local.g)
            u2 = 0.0
            for i in range(6):
                u2 += e[i] * local.g[i]
            robust = 1.0 / (1.0 + u2 / c2)
            weight = robust * batch.share[r] * loss.weight
            for i in range(6):
                local.g[i] *= weight
                for j in range(6):
                    local.H[i, j] = weight * loss.information[n, i, j]
            gather(total, local, J, room)
            cost += loss.weight * batch.share[r] * 0.5 * c2 * np.log1p(u2 / c2)
            squared += u2 * robust
        for i in range(12):
            index[i] = NODE_DIM * (n + i // 6) + i % 6
            index[12 + i] = dim + index[i]
        scatter(normal, index, total, 1.0)
    return cost, squared


@kernel
def _half(T_wanted, T, share, e, J, column, twist, scratch):
    """Add a knot's share of the residual to e, and write its columns of J: nodes n and n + 1."""
    error, work = twist[0], scratch[0]
    by_last, Ad, by_first, back = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.eye(4)
    pose_error(T_wanted, T, error, by_last, work)
    relative(T, np.eye(4), back)
    adjoint(back, Ad)
    product(by_last, Ad, by_first)
    for i in range(6):
        e[i] += share * error.x[i]
        for j in range(6):
            J[i, column + j] = -share * by_first[i, j]
            J[i, column + 6 + j] = share * by_last[i, j]
