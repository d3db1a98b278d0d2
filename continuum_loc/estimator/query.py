"""
Mean and covariance of the state at any time and arclength.

In the window, behind it and ahead of it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from continuum_loc import lie
from continuum_loc.estimator import gp
from continuum_loc.estimator.interpolation import body_between, BodyState
from continuum_loc.estimator.state import (
    Column,
    ends_in_time,
    Grid,
    NODE_DIM,
    POSE,
    STRAIN,
    TIME_EPSILON,
    VELOCITY,
)
from continuum_loc.estimator.window import Window
import numpy as np

SMOOTHED_BY = 2  # knots


@dataclass(frozen=True, slots=True, eq=False)
class PastColumn:
    """
    A column of the past.

    covariance (N - 1, 36, 36) of each neighbouring pair of nodes; jerked (N,): what the process
    noise was multiplied by in the interval that follows.
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
        """
        Keep a column once `SMOOTHED_BY` later ones have smoothed it.

        More of them would change it little and cost much.
        """
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
        """
        Return the two columns that enclose `time`.

        Raises ValueError where there are none.
        """
        for older, newer in zip(self._columns, list(self._columns)[1:], strict=False):
            if older.column.time - TIME_EPSILON <= time <= newer.column.time + TIME_EPSILON:
                return older, newer
        reach = (
            f'{self._columns[0].column.time:.3f} s'
            if self._columns
            else 'no time behind the window'
        )
        raise ValueError(f'time {time:.3f} s is not kept; the history reaches back to {reach}')


def state_at(window: Window, history: History, time: float, s: float) -> BodyState:
    """Evaluate the state at `time` [s since the epoch] and arclength s [m]."""
    n, offset = window.grid.segment(s)
    if time > window.columns[-1].time:
        T, strain, velocity, P = _ahead(window, time, n)
    elif time >= window.columns[0].time:
        T, strain, velocity, P = _inside(window, time, n)
    else:
        T, strain, velocity, P = _behind(window, history, time, n)
    return _along(window.grid, n, offset, T, strain, velocity, P, window.priors.strain_psd[n])


def _inside(window: Window, time: float, n: int):
    k = window.knot_before(time)
    A = _rows_of(window, n)
    P = window.chain.covariance(k, np.concatenate([A, 0.0 * A]), np.concatenate([0.0 * A, A]))
    return _between(window, k, P, time, n)


def _six(at: int) -> slice:
    """Rows or columns of one part of a node, of which `at` is the first."""
    return slice(at, at + 6)


def _rows_of(window: Window, n: int) -> np.ndarray:
    """(36, D) selection of two neighbouring nodes' rows."""
    return np.eye(2 * NODE_DIM, window.grid.dim, NODE_DIM * n)


def _behind(window: Window, history: History, time: float, n: int):
    older, newer = history.around(time)
    # Neighbouring columns are strongly correlated; each one's own covariance at both ends, taken
    # as fully correlated, is the larger of the two readings and so the safe one.
    u = (time - older.column.time) / (newer.column.time - older.column.time)
    P = (1.0 - u) * older.covariance[n] + u * newer.covariance[n]
    body = body_between(older.column, newer.column, time)
    nodes = slice(n, n + 2)
    P = P + _open_bridge(window, older.column, newer.column, time, n, older.jerked)
    return body.T[nodes], body.strain[nodes], body.velocity[nodes], P


def _between(window: Window, k: int, P: np.ndarray, time: float, n: int):
    """Two nodes at `time` in interval k, and their joint covariance (36, 36)."""
    a, b = window.column(k), window.column(k + 1)
    d, tau = b.time - a.time, time - a.time
    u, m = tau / d, NODE_DIM
    J = np.zeros((2 * m, 4 * m))
    T, velocity = np.empty((2, 4, 4)), np.empty((2, 6))
    for i in range(2):
        T[i], velocity[i], J_pose, J_rate = gp.interpolate(ends_in_time(a, b, n + i), tau)
        for rows, part in ((POSE, J_pose), (VELOCITY, J_rate)):
            for block, column in enumerate((POSE, VELOCITY, 2 * m + POSE, 2 * m + VELOCITY)):
                J[_six(m * i + rows), _six(m * i + column)] = part[:, _six(6 * block)]
        at = m * i + STRAIN
        J[_six(at), _six(at)] = (1.0 - u) * np.eye(6)
        J[_six(at), _six(2 * m + at)] = u * np.eye(6)
    nodes = slice(n, n + 2)
    strain = (1.0 - u) * a.strain[nodes] + u * b.strain[nodes]
    open_ = _open_bridge(window, a, b, time, n, window.intervals[k].jerked)
    return T, strain, velocity, J @ P @ J.T + open_


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
        start = NODE_DIM * i
        at = start + np.concatenate([np.arange(POSE, POSE + 6), np.arange(VELOCITY, VELOCITY + 6)])
        Q[np.ix_(at, at)] = np.kron(motion, np.diag(jerked[n + i] * psd[n + i]))
        at = start + np.arange(STRAIN, STRAIN + 6)
        Q[at, at] = jerked[n + i] * strain / window.priors.inverse_strain_rate_psd
    return Q


def _ahead(window: Window, time: float, n: int):
    """Two nodes predicted from the newest column at constant body-frame velocity."""
    newest, dt = window.column(-1), time - window.columns[-1].time
    k, m = len(window.intervals) - 1, NODE_DIM
    P = window.chain.covariance(k, np.zeros((2 * m, window.grid.dim)), _rows_of(window, n))
    later = newest.predict(dt)
    J = np.eye(2 * m)
    for i in range(2):
        twist, at = dt * newest.velocity[n + i], m * i
        J[_six(at), _six(at)] = lie.adjoint(lie.exp(-twist))
        J[_six(at), _six(at + VELOCITY)] = dt * lie.right_jacobian(twist)
    growth = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    nodes = slice(n, n + 2)
    covariance = J @ P @ J.T + _process_noise(window, n, window.intervals[k].jerked, growth, dt)
    return later.T[nodes], later.strain[nodes], later.velocity[nodes], covariance


def _along(grid: Grid, n: int, offset: float, T, strain, velocity, P, strain_psd) -> BodyState:
    """
    From two nodes to an arclength between them.

    Pose and strain by the same Hermite in s, velocity linearly in the frames that the exact
    adjoint carries from the nearer node.
    """
    ds, m = grid.s[n + 1] - grid.s[n], NODE_DIM
    T_s, strain_s, J_pose, J_rate = gp.interpolate(
        gp.Ends(T[0], strain[0], T[1], strain[1], ds), offset
    )
    J = np.zeros((m, 2 * m))
    for rows, part in ((POSE, J_pose), (STRAIN, J_rate)):
        for block, column in enumerate((POSE, STRAIN, m + POSE, m + STRAIN)):
            J[_six(rows), _six(column)] = part[:, _six(6 * block)]
    u = offset / ds
    carried = [
        weight * lie.adjoint(lie.inverse(T_s) @ T_node)
        for weight, T_node in zip((1.0 - u, u), T, strict=True)
    ]
    J[_six(VELOCITY), _six(VELOCITY)], J[_six(VELOCITY), _six(m + VELOCITY)] = carried
    covariance = J @ P @ J.T
    covariance[:12, :12] += np.kron(gp.bridge(offset, ds), np.diag(strain_psd))
    return BodyState(
        T_s, strain_s, carried[0] @ velocity[0] + carried[1] @ velocity[1], covariance
    )
