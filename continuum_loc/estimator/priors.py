"""
Prior factors of one interval: the Gaussian process in time and arclength, rest strain, base, bias.

An interval holds the time prior between its two columns and the factors of the *newer* column
alone (its space prior, rest strain, base); those of the very first column are in the start of the
chain. So each factor stands once.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie, lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.estimator import gp
from continuum_loc.estimator.border import Border
from continuum_loc.estimator.normal import add_rows, Normal
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import (
    Column,
    ends_along,
    ends_in_time,
    frame_row,
    Grid,
    NODE_DIM,
    rows_along,
    rows_in_time,
    STRAIN,
    VELOCITY,
)
from continuum_loc.robot import RobotDescription
import numpy as np

BASE_TRANSVERSE_VELOCITY = 0.02  # [m/s] the base slides along its axis only
BASE_ANGULAR_VELOCITY = 0.02  # [rad/s]
MOVING_FACTOR = 10.0  # on the initial velocity's spread, for a body found in motion
LET_GO = 1e-6  # of the information on a fixed base that is found to be elsewhere
BASE_PLAIN = 100.0  # ten sigmas: a body that is swung pulls its base by several
ANYWHERE = (10.0, 3.0)  # [m, rad] spread of a base of which nothing is known but its measurement
ASTRAY = (0.1, 0.2)  # [m, rad] spread about where a carried base, or its frame, was last
STEADY = (1e-4, 1e-4)  # [m/sqrt(s), rad/sqrt(s)] drift of odometry at rest


class InTime(NamedTuple):
    """The prior from knot to knot: inverse densities of its noise, and its loss."""

    inverse_velocity_psd: np.ndarray  # (N, 6)
    inverse_strain_psd: np.ndarray  # (6,)
    inverse_bias_psd: float
    cauchy: float
    least: float  # one over the most that a jerk multiplies the noise by


class OfColumn(NamedTuple):
    """The prior of one column: in arclength s (N,), of its rest strain and of its base."""

    s: np.ndarray
    inverse_strain_psd: np.ndarray  # (N - 1, 6) of its slope
    inverse_velocity_psd: np.ndarray  # (6,) of its slope
    rest: np.ndarray  # (6,)
    rest_information: np.ndarray  # (6,)
    T_map_base: np.ndarray  # (4, 4)
    base_information: np.ndarray  # (2, 6) of the base's pose and of its velocity
    base_reach: np.ndarray  # (6,) of its pose, with what it may be off by as built


class OfFrame(NamedTuple):
    """
    How the frame of a measured base may lie in `map`, as poses of the base see it.

    walk (6,): variance per second; drift2 (2,): square of the share of the way and of the turn by
    which it drifts; pull (6,): information per second that it is `map`.
    """

    walk: np.ndarray
    drift2: np.ndarray
    pull: np.ndarray


class OfStart(NamedTuple):
    """What is known beforehand of a carried base (6,), and of the frame (6,): information."""

    base: np.ndarray
    frame: np.ndarray


class Priors:
    """
    The prior of a robot with given settings, on a grid.

    velocity_psd (N, 6) by node, strain_rate_psd (6,) and strain_psd (N - 1, 6) by segment: the
    process noise. rest: (6,) strain and T_map_base: (4, 4) of the body before any measurement.
    """

    def __init__(self, robot: RobotDescription, grid: Grid, settings: EstimatorSettings):
        prior, gyro = settings.prior, settings.gyro
        self.grid, self.memory = grid, prior.memory
        self.rest = np.array(robot.backbone.rest_strain)
        share = prior.velocity_at_base
        grown = share + (1.0 - share) * (grid.s / grid.s[-1]) ** 2
        self._held_psd = grown[:, None] * np.array(prior.velocity)
        self._carried_psd = self._held_psd + _carried(robot, grid)
        self._carried = robot.base.mode != 'fixed'
        self.velocity_psd = self._carried_psd if self._carried else self._held_psd
        self.inverse_strain_rate_psd = 1.0 / np.array(prior.strain_rate)
        step_psd = np.square(prior.strain_step) / np.diff(grid.s)[:, None]
        self.strain_psd = np.array(prior.strain) + grid.steps[:, None] * step_psd
        self.T_map_base, self._base_information = _base_of(robot)
        self._base_reach = self._reach_of(robot, settings)
        self._drifts = robot.base.measurement.drift > 0.0
        self._own_frame = self._drifts or robot.base.measurement.frame != 'map'
        self._of_frame, self._of_start = _frame_of(robot), _start_of(robot)
        self._T_map_start = robot.base.T_map_base
        self._work = gp.new_workspace()
        self._bias_information = 1.0 / gyro.bias_sigma**2
        self._initial_velocity = np.repeat(1.0 / np.square(prior.initial_velocity_sigma), 3)
        self._in_time = InTime(
            1.0 / self.velocity_psd,
            self.inverse_strain_rate_psd,
            1.0 / gyro.bias_walk**2,
            prior.cauchy,
            1.0 / prior.jerked,
        )
        self._of_column = OfColumn(
            grid.s,
            1.0 / self.strain_psd,
            1.0 / np.array(prior.velocity_slope),
            self.rest,
            1.0 / np.square(robot.backbone.rest_strain_sigma),
            self.T_map_base,
            self._base_information,
            self._base_reach,
        )

    def _reach_of(self, robot: RobotDescription, settings: EstimatorSettings) -> np.ndarray:
        """Make `OfColumn.base_reach`."""
        information = self._base_information[0]
        if not settings.calibration.enabled or robot.base.mode != 'fixed':
            return information
        return 1.0 / (1.0 / information + np.square(robot.tolerances.base_sigma))

    def describe(self, robot: RobotDescription) -> None:
        """Take the base and the rest strain of a robot with other constants (`parameters`)."""
        self.T_map_base, _ = _base_of(robot)
        self._T_map_start = robot.base.T_map_base
        self.rest = np.array(robot.backbone.rest_strain)
        self._of_column = self._of_column._replace(rest=self.rest, T_map_base=self.T_map_base)

    def let_go(self, loose: bool) -> bool:
        """
        Take a fixed base for one that is carried, or believe it again; True if that is new.

        For a base of which it was found that it is not where it is said to be.
        """
        if self._carried or loose == (self.velocity_psd is self._carried_psd):
            return False
        self.velocity_psd = self._carried_psd if loose else self._held_psd
        self._in_time = self._in_time._replace(inverse_velocity_psd=1.0 / self.velocity_psd)
        share = LET_GO if loose else 1.0
        self._of_column = self._of_column._replace(
            base_information=share * self._base_information, base_reach=share * self._base_reach
        )
        return True

    def start(
        self,
        column: Column,
        first: Column | None = None,
        moving: bool = False,
        wandered: bool = False,
    ) -> Normal:
        """
        Return the first column's own factors, linearised there: what is known beforehand.

        first: the column about which a carried base and its frame are known, by default itself.
        `moving` loosens the velocity, for a body found in the middle of its motion; `wandered`
        what was known of a carried base at the very start.
        """
        velocity = self._initial_velocity * (MOVING_FACTOR**-2 if moving else 1.0)
        start = Normal.zeros(self.grid.dim)
        _add_column(start, column, self._of_column, 1.0, self._work)
        for n in range(self.grid.nodes):
            at = slice(NODE_DIM * n + VELOCITY, NODE_DIM * n + VELOCITY + 6)
            start.H[at, at] += np.diag(velocity)
            start.g[at] += velocity * column.velocity[n]
        biases = np.arange(self.grid.bias_offset, self.grid.frame_offset)
        start.H[biases, biases] += self._bias_information
        if self._carried:
            self._start_base(start, column, first or column, wandered)
        return start

    def _start_base(self, start: Normal, column: Column, first: Column, wandered: bool) -> None:
        """Add where a carried base begins, and where the frame of its measurement lies."""
        base, frame = self._of_start
        if wandered:
            base, frame = (np.minimum(one, _loosely(ASTRAY)) for one in (base, frame))
        _add_known(start, 0, first.T[0], column.T[0], base)
        for f in range(self.grid.frames):
            # About `map` itself, unless the frame is another one or drifts.
            known = first.T_map_frame[f] if self._own_frame else np.eye(4)
            information = frame if self._own_frame else self._of_start.frame
            at = self.grid.frame_offset + 6 * f
            seen = lie.adjoint(lie.inverse(column.T[0]) @ column.T_map_frame[f])
            _add_known(start, at, known, column.T_map_frame[f], information, seen)

    def add(self, normal: Normal, a: Column, b: Column) -> tuple[float, np.ndarray]:
        """
        Add the interval's time prior and the newer column's own factors.

        Returns their cost, and what the process noise of each node (N,) was multiplied by. Rest
        strain and base pose are one observation per `memory`, not one per knot: a knot counts
        them by its share of that time.
        """
        share, jerked = self.share(b.time - a.time), np.empty(self.grid.nodes)
        priors = self._in_time, self._of_column
        cost = _add(normal, a, b, *priors, share, jerked, self._work)
        if self.grid.frames:
            cost += _add_frame(normal, a, b, self._of_frame, self._work)
        return cost, jerked

    def share(self, duration: float) -> float:
        """Say what rest strain and base pose count by at a knot so long after another [s]."""
        return min(duration / self.memory, 1.0)

    def bordered(self, border: Border, column: Column, share: float, of: Parameters) -> None:
        """Add what one column's own factors say of base and length; `border` is that column's."""
        prior, nodes = self._of_column, self.grid.nodes
        error = lie.log(lie.inverse(prior.T_map_base) @ column.T[0])
        right, left = lie.right_jacobian_inverse(error), lie.left_jacobian_inverse(error)
        back = lie.adjoint(lie.inverse(prior.T_map_base) @ self._T_map_start)
        columns = of.columns('base', [''])[0]
        W = np.diag(share * prior.base_information[0])
        far = error @ (prior.base_reach * error)
        W *= BASE_PLAIN / max(BASE_PLAIN, far)  # as `_add_base` lets it go
        border.add(np.arange(6), right, columns, -left @ back, W, error)
        rows = NODE_DIM * np.arange(nodes) + STRAIN
        off = column.strain[:, 0] - prior.rest[0]
        W = share * prior.rest_information[0] * np.eye(nodes)
        by_length = np.full((nodes, 1), -prior.rest[0])
        border.add(rows, np.eye(nodes), of.columns('length', [''])[0], by_length, W, off)


def _base_of(robot: RobotDescription) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the base in the middle of its travel, and `OfColumn.base_information`."""
    base, insertion = robot.base, robot.base.insertion
    middle = 0.0 if insertion.mode == 'fixed' else float(np.mean(insertion.range))
    sigma = base.sigma
    rate = np.array([BASE_TRANSVERSE_VELOCITY] * 3 + [BASE_ANGULAR_VELOCITY] * 3)
    if insertion.mode != 'fixed':
        sigma[0] = max(insertion.range[1] - insertion.range[0], 1e-3)
        rate[0] = 1.0
    along = lie.exp(np.array([middle, 0, 0, 0, 0, 0]))
    if base.mode != 'fixed':
        rate = np.repeat(np.square(base.speed), 3)
        return base.T_map_base @ along, np.stack([np.zeros(6), 1.0 / rate])
    return base.T_map_base @ along, np.stack([sigma**-2.0, rate**-2.0])


def _carried(robot: RobotDescription, grid: Grid) -> np.ndarray:
    """(N, 6) process noise of nodes that are carried along by their base, as if straight."""
    shift, turn = robot.base.acceleration
    psd = np.empty((grid.nodes, 6))
    psd[:, 0], psd[:, 3:] = shift, turn
    psd[:, 1:3] = shift + turn * np.square(grid.s)[:, None]
    return psd


def _lasting(robot: RobotDescription) -> np.ndarray:
    """Variance (6,) of the part of a base's error that lasts."""
    return np.square(robot.base.sigma)


def _loosely(spread: tuple[float, float]) -> np.ndarray:
    return np.repeat(1.0 / np.square(spread), 3)


def _start_of(robot: RobotDescription) -> OfStart:
    """Make `OfStart`: a free base is known by its description, a measured one by its frame."""
    known, insertion = 1.0 / _lasting(robot), robot.base.insertion
    if insertion.mode == 'unknown' and robot.base.mode == 'free':
        known[0] = 1.0 / (1.0 / known[0] + np.ptp(insertion.range) ** 2)
    return OfStart(known if robot.base.mode == 'free' else _loosely(ANYWHERE), known)


def _frame_of(robot: RobotDescription) -> OfFrame:
    told, lasting = robot.base.measurement, _lasting(robot)
    drift2 = np.full(2, told.drift**2)
    if told.drift > 0.0:
        return OfFrame(np.repeat(np.square(STEADY), 3), drift2, np.zeros(6))
    pull = np.zeros(6) if told.frame != 'map' else 1.0 / (lasting * told.lasting)
    return OfFrame(2.0 * lasting / told.lasting, drift2, pull)


def _add_known(
    normal: Normal,
    at: int,
    T_known: np.ndarray,
    T: np.ndarray,
    information: np.ndarray,
    seen: np.ndarray | None = None,
) -> None:
    """Add that T (4, 4), at row `at`, is T_known: information (6,) in T's frame, or as `seen`."""
    e = lie.log(lie.inverse(T_known) @ T)
    J = lie.right_jacobian_inverse(e)
    if seen is not None:
        e, J = seen @ e, seen @ J
    rows = slice(at, at + 6)
    normal.H[rows, rows] += np.triu(J.T @ (information[:, None] * J))
    normal.g[rows] += J.T @ (information * e)


@kernel
def _add(normal, a, b, in_time, of_column, share, jerked, work):
    """Add all factors of an interval; returns their cost."""
    dim = normal.g.shape[0] // 2
    cost = _add_time(normal, a, b, in_time, jerked, work)
    _add_bias(normal, a, b, in_time.inverse_bias_psd / (b.time - a.time))
    newer = Normal(normal.H[dim:, dim:], normal.g[dim:])
    return cost + 0.5 * _add_column(newer, b, of_column, share, work)


@kernel
def _add_time(normal, a, b, prior, jerked, work):
    """
    Add each node's step from knot to knot, under a Cauchy loss; returns the robust cost.

    The noise of a step is a heavy-tailed one that all components of a node share: its variance is
    the settings' for a body that moves as usual, and grows where it is jerked, up to 1 / least;
    jerked (N,) gets by how much.
    """
    e, J, index = np.empty(12), np.empty((12, 24)), np.empty(24, np.int64)
    information, walk = np.empty(6), np.empty(6)
    dim, dt, least = normal.g.shape[0] // 2, b.time - a.time, prior.least
    cost, c2 = 0.0, NODE_DIM * prior.cauchy * prior.cauchy
    for n in range(a.T.shape[0]):
        gp.motion_error(ends_in_time(a, b, n), e, J, work)
        squared = gp.motion_squared(e, dt, prior.inverse_velocity_psd[n])
        for i in range(6):
            walk[i] = b.strain[n, i] - a.strain[n, i]
            squared += prior.inverse_strain_psd[i] / dt * walk[i] * walk[i]
        robust = max(1.0 / (1.0 + squared / c2), least)
        jerked[n] = 1.0 / robust
        lossy = min(squared, c2 * (1.0 / least - 1.0))  # beyond it the loss is a square again
        cost += 0.5 * (c2 * np.log1p(lossy / c2) + least * (squared - lossy))
        for i in range(6):
            information[i] = robust * prior.inverse_velocity_psd[n, i]
        rows_in_time(n, dim, index)
        gp.add_motion(normal, index, e, J, dt, information)
        for i in range(6):
            weight = robust * prior.inverse_strain_psd[i] / dt
            _add_step(normal, NODE_DIM * n + STRAIN + i, weight, walk[i])
    return cost


@kernel
def _add_step(normal, older, weight, step):
    """Add the random walk of one entry of a column, which went by `step` to the newer one."""
    newer = older + normal.g.shape[0] // 2
    normal.H[older, older] += weight
    normal.H[newer, newer] += weight
    normal.H[older, newer] -= weight
    normal.g[older] -= weight * step
    normal.g[newer] += weight * step


@kernel
def _add_bias(normal, a, b, weight):
    for m in range(a.bias.shape[0]):
        for i in range(3):
            row = NODE_DIM * a.T.shape[0] + 3 * m + i
            _add_step(normal, row, weight, b.bias[m, i] - a.bias[m, i])


@kernel
def _add_frame(normal, a, b, prior, work):
    """
    Add how the frame of a measured base moves in `map`; the cost.

    Its errors are those of the base: a turn of it about the base, not about its own far origin.
    """
    at, dim = work[0], normal.g.shape[0] // 2
    scratch, seen = at.scratch, np.empty((6, 6))
    e, J, weights = np.empty(6), np.empty((6, 12)), np.empty(6)
    lie_kernels.pose_error(a.T[0], b.T[0], at.gamma, at.right_gamma, scratch)
    way, dt = at.gamma.x, b.time - a.time
    for i in range(6):
        first = 3 * (i // 3)
        moved2 = way[first] ** 2 + way[first + 1] ** 2 + way[first + 2] ** 2
        weights[i] = 1.0 / (prior.walk[i] * dt + prior.drift2[i // 3] * moved2)
    lie_kernels.relative(b.T[0], b.T_map_frame[0], scratch.pose)
    lie_kernels.adjoint(scratch.pose, seen)
    lie_kernels.pose_error(a.T_map_frame[0], b.T_map_frame[0], at.xi, at.right, scratch)
    lie_kernels.apply(seen, at.xi.x, e)
    for i in range(6):
        for j in range(6):
            J[i, j] = J[i, 6 + j] = 0.0
            for k in range(6):
                J[i, j] -= seen[i, k] * (at.right[k, j] - at.xi.ad[k, j])  # J_l^-1
                J[i, 6 + j] += seen[i, k] * at.right[k, j]
    index = frame_row(a) + np.arange(12)
    index[6:] += dim - 6
    squared = add_rows(normal, index, e, J, weights)
    lie_kernels.pose_error(np.eye(4), b.T_map_frame[0], at.xi, at.right, scratch)
    lie_kernels.apply(seen, at.xi.x, e)
    for i in range(6):
        for j in range(6):
            J[i, j] = 0.0
            for k in range(6):
                J[i, j] += seen[i, k] * at.right[k, j]
    return 0.5 * (squared + add_rows(normal, index[6:], e, J[:, :6], prior.pull * dt))


@kernel
def _add_column(normal, column, prior, share, work):
    """Add the factors of one column to its own equations; returns the squared error."""
    squared = _add_space(normal, column, prior, share, work)
    return squared + _add_base(normal, column, prior, share, work)


@kernel
def _add_space(normal, column, prior, share, work):
    """Add rest strain, and strain and velocity along the segments; the squared error."""
    e, J, index = np.empty(12), np.empty((12, 24)), np.empty(24, np.int64)
    weights, s = np.empty(6), prior.s
    squared = 0.0
    for n in range(s.shape[0]):
        for i in range(6):
            off = column.strain[n, i] - prior.rest[i]
            row = NODE_DIM * n + STRAIN + i
            information = prior.rest_information[i] * share
            normal.H[row, row] += information
            normal.g[row] += information * off
            squared += information * off * off
        if n == s.shape[0] - 1:
            break
        bent = ends_along(column.T, column.strain, s, n)
        gp.motion_error(bent, e, J, work)
        rows_along(n, STRAIN, index)
        squared += gp.add_motion(normal, index, e, J, bent.span, prior.inverse_strain_psd[n])
        moved = ends_along(column.T, column.velocity, s, n)
        gp.transport_error(moved, e[:6], J[:6], work)
        rows_along(n, VELOCITY, index)
        for i in range(6):
            weights[i] = prior.inverse_velocity_psd[i] / moved.span
        squared += add_rows(normal, index, e[:6], J[:6], weights)
    return squared


@kernel
def _add_base(normal, column, prior, share, work):
    """
    Add the base's pose and velocity; twice their cost.

    A base that all the rest has far from where it should be is let go: a square up to BASE_PLAIN,
    and its logarithm beyond.
    """
    at, velocity = work[0], column.velocity[0]
    lie_kernels.pose_error(prior.T_map_base, column.T[0], at.xi, at.right, at.scratch)
    error, J, squared, far = at.xi.x, at.right, 0.0, 0.0
    for i in range(6):
        rate = prior.base_information[1, i] * velocity[i] * velocity[i]
        squared += prior.base_information[0, i] * error[i] * error[i] + rate
        far += prior.base_reach[i] * error[i] * error[i] + rate
    if far > BASE_PLAIN:
        share *= BASE_PLAIN / far
        squared *= 1.0 + np.log(far / BASE_PLAIN)
    cost = share * squared
    for i in range(6):
        information = prior.base_information[0, i] * share
        rate = prior.base_information[1, i] * share
        for j in range(6):
            weighted = information * J[i, j]
            normal.g[j] += weighted * error[i]
            for k in range(j, 6):
                normal.H[j, k] += weighted * J[i, k]
        normal.H[VELOCITY + i, VELOCITY + i] += rate
        normal.g[VELOCITY + i] += rate * velocity[i]
    return cost
