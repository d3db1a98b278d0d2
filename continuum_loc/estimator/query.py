"""Mean and covariance of the state at any time, in the window, behind or ahead, and arclength."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.errors import QueryError
from continuum_loc.estimator import gp
from continuum_loc.estimator.interpolation import body_between, BodyState, interpolated, MOTION
from continuum_loc.estimator.state import (
    Column,
    ends_along,
    Grid,
    NODE_DIM,
    POSE_PART,
    STRAIN_PART,
    TIME_EPSILON,
    VELOCITY_PART,
)
from continuum_loc.estimator.window import Window
import numpy as np

SMOOTHED_BY = 2  # knots


@dataclass(frozen=True, slots=True, eq=False)
class PastColumn:
    """
    A column behind the window, with the covariance (N - 1, 36, 36) of each two neighbouring nodes.

    jerked (N,): what the process noise was multiplied by in the interval that follows.
    """

    column: Column
    covariance: np.ndarray
    jerked: np.ndarray


class History:
    """Columns behind the window, back to `duration` [s]: memory does not grow with the run."""

    def __init__(self, duration: float):
        self._duration = duration
        self._columns: deque[PastColumn] = deque()

    def note(self, window: Window) -> None:
        """Keep a column once `SMOOTHED_BY` later ones are there; more would change little."""
        k = len(window.columns) - 1 - SMOOTHED_BY
        if self._duration <= 0.0 or k < 0:
            return
        column = window.column(k)
        if self._columns and column.time < self._columns[-1].column.time + TIME_EPSILON:
            return
        nodes = np.eye(NODE_DIM * window.grid.nodes, window.grid.dim)
        P = window.chain.covariance(k, nodes, size=2 * NODE_DIM, step=NODE_DIM)
        self._columns.append(PastColumn(column, P, window.intervals[k].jerked))
        while self._columns[0].column.time < column.time - self._duration:
            self._columns.popleft()

    def around(self, time: float) -> tuple[PastColumn, PastColumn]:
        """Return the two columns that enclose `time`; raises QueryError where there are none."""
        for older, newer in zip(self._columns, list(self._columns)[1:], strict=False):
            if older.column.time - TIME_EPSILON <= time <= newer.column.time + TIME_EPSILON:
                return older, newer
        reach = f'{self._columns[0].column.time:.3f} s' if self._columns else 'no time at all'
        raise QueryError(f'time {time:.3f} s is not kept; the history reaches back to {reach}')


class Pair(NamedTuple):
    """Two neighbouring nodes: T (2, 4, 4), strain and velocity (2, 6), covariance (36, 36)."""

    T: np.ndarray
    strain: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray


def state_at(window: Window, history: History, time: float, s: float) -> BodyState:
    """Evaluate the state at `time` [s since the epoch] and arclength s [m]."""
    n, offset = window.grid.segment(s)
    if time > window.columns[-1].time:
        pair = _ahead(window, time, n)
    elif time >= window.columns[0].time:
        pair = _inside(window, time, n)
    else:
        pair = _behind(window, history, time, n)
    return _along(window.grid, n, offset, pair, window.priors.strain_psd[n])


def _rows_of(window: Window, n: int) -> np.ndarray:
    """(36, D) selection of two neighbouring nodes' rows."""
    return np.eye(2 * NODE_DIM, window.grid.dim, NODE_DIM * n)


def _inside(window: Window, time: float, n: int) -> Pair:
    k, m, A = window.knot_before(time), NODE_DIM, _rows_of(window, n)
    P = window.chain.covariance(k, np.concatenate([A, 0.0 * A]), np.concatenate([0.0 * A, A]))
    a, b, nodes = window.column(k), window.column(k + 1), np.arange(n, n + 2)
    u = (time - a.time) / (b.time - a.time)
    at = interpolated(a, b, np.full(2, time - a.time), nodes, pose=True, rate=True)
    J, ends = np.zeros((2 * m, 4 * m)), np.concatenate([MOTION, 2 * m + MOTION])
    for i in range(2):
        both = np.concatenate([at.J_pose[i], at.J_rate[i]])
        J[np.ix_(m * i + MOTION, m * i + ends)] = both
        strain = m * i + np.arange(m)[STRAIN_PART]
        J[strain, strain], J[strain, 2 * m + strain] = 1.0 - u, u
    open_ = _open_bridge(window, a, b, time, n, window.intervals[k].jerked)
    strain = (1.0 - u) * a.strain[nodes] + u * b.strain[nodes]
    return Pair(at.T, strain, at.v, J @ P @ J.T + open_)


def _behind(window: Window, history: History, time: float, n: int) -> Pair:
    older, newer = history.around(time)
    # Neighbouring columns are strongly correlated; each one's own covariance at both ends, taken
    # as fully correlated, is the larger of the two readings and so the safe one.
    u = (time - older.column.time) / (newer.column.time - older.column.time)
    P = (1.0 - u) * older.covariance[n] + u * newer.covariance[n]
    body, nodes = body_between(older.column, newer.column, time), slice(n, n + 2)
    P = P + _open_bridge(window, older.column, newer.column, time, n, older.jerked)
    return Pair(body.T[nodes], body.strain[nodes], body.velocity[nodes], P)


def _ahead(window: Window, time: float, n: int) -> Pair:
    """Predict from the newest column at constant body-frame velocity."""
    newest, dt = window.column(-1), time - window.columns[-1].time
    k, m = len(window.intervals) - 1, NODE_DIM
    P = window.chain.covariance(k, np.zeros((2 * m, window.grid.dim)), _rows_of(window, n))
    later, J = newest.predict(dt), np.eye(2 * m)
    for i in range(2):
        mine = slice(m * i, m * i + m)
        twist, own = dt * newest.velocity[n + i], J[mine, mine]
        own[POSE_PART, POSE_PART] = lie.adjoint(lie.exp(-twist))
        own[POSE_PART, VELOCITY_PART] = dt * lie.right_jacobian(twist)
    growth = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    nodes = slice(n, n + 2)
    covariance = J @ P @ J.T + _process_noise(window, n, window.intervals[k].jerked, growth, dt)
    return Pair(later.T[nodes], later.strain[nodes], later.velocity[nodes], covariance)


def _open_bridge(
    window: Window, a: Column, b: Column, time: float, n: int, jerked: np.ndarray
) -> np.ndarray:
    """Covariance (36, 36) that two columns leave open of the two nodes between them."""
    d, tau = b.time - a.time, time - a.time
    return _process_noise(window, n, jerked, gp.bridge(tau, d), tau * (d - tau) / d)


def _process_noise(
    window: Window, n: int, jerked: np.ndarray, motion: np.ndarray, strain: float
) -> np.ndarray:
    """
    Covariance (36, 36) of nodes n and n + 1: `motion` (2, 2) and `strain` times the noise.

    jerked (N,): what the noise of each node is multiplied by.
    """
    Q, psd = np.zeros((2 * NODE_DIM, 2 * NODE_DIM)), window.priors.velocity_psd
    for i in range(2):
        at = NODE_DIM * i + MOTION
        Q[np.ix_(at, at)] = np.kron(motion, np.diag(jerked[n + i] * psd[n + i]))
        at = NODE_DIM * i + np.arange(NODE_DIM)[STRAIN_PART]
        Q[at, at] = jerked[n + i] * strain / window.priors.inverse_strain_rate_psd
    return Q


def _along(grid: Grid, n: int, offset: float, pair: Pair, strain_psd: np.ndarray) -> BodyState:
    """
    From two nodes to an arclength between them.

    Pose and strain by the same Hermite in s, velocity linearly in the frames that the exact
    adjoint carries from the nearer node.
    """
    ends, m = ends_along(pair.T, pair.strain, grid.s[n:][:2], 0), NODE_DIM
    at, u = gp.interpolate(ends, offset), offset / ends.span
    J = np.zeros((m, 2 * m))
    J[:12, :12], J[:12, m:][:, :12] = np.split(np.concatenate([at.J_pose, at.J_rate]), 2, axis=1)
    carried = [
        weight * lie.adjoint(lie.inverse(at.T) @ T_node)
        for weight, T_node in zip((1.0 - u, u), pair.T, strict=True)
    ]
    J[VELOCITY_PART, :m][:, VELOCITY_PART], J[VELOCITY_PART, m:][:, VELOCITY_PART] = carried
    covariance = J @ pair.covariance @ J.T
    covariance[:12, :12] += np.kron(gp.bridge(offset, ends.span), np.diag(strain_psd))
    velocity = carried[0] @ pair.velocity[0] + carried[1] @ pair.velocity[1]
    return BodyState(at.T, at.v, velocity, covariance)
