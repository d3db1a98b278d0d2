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
        self.velocity_psd = grown[:, None] * np.array(prior.velocity)
        self.inverse_strain_rate_psd = 1.0 / np.array(prior.strain_rate)
        step_psd = np.square(prior.strain_step) / np.diff(grid.s)[:, None]
        self.strain_psd = np.array(prior.strain) + grid.steps[:, None] * step_psd
        self.T_map_base, base_information = _base_of(robot)
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
            base_information,
        )

    def start(self, column: Column, moving: bool = False) -> Normal:
        """
        Return the first column's own factors, linearised there: what is known beforehand.

        `moving` loosens the velocity, for a body found in the middle of its motion.
        """
        velocity = self._initial_velocity * (MOVING_FACTOR**-2 if moving else 1.0)
        start = Normal.zeros(self.grid.dim)
        _add_column(start, column, self._of_column, 1.0, self._work)
        for n in range(self.grid.nodes):
            at = slice(NODE_DIM * n + VELOCITY, NODE_DIM * n + VELOCITY + 6)
            start.H[at, at] += np.diag(velocity)
            start.g[at] += velocity * column.velocity[n]
        biases = np.arange(self.grid.bias_offset, self.grid.dim)
        start.H[biases, biases] += self._bias_information
        return start

    def add(self, normal: Normal, a: Column, b: Column) -> tuple[float, np.ndarray]:
        """
        Add the interval's time prior and the newer column's own factors.

        Returns their cost, and what the process noise of each node (N,) was multiplied by. Rest
        strain and base pose are one observation per `memory`, not one per knot: a knot counts
        them by its share of that time.
        """
        share, jerked = self.share(b.time - a.time), np.empty(self.grid.nodes)
        priors = self._in_time, self._of_column
        return _add(normal, a, b, *priors, share, jerked, self._work), jerked


    def share(self, duration: float) -> float:
        """What rest strain and base pose count by at a knot so long after another [s]."""
        return min(duration / self.memory, 1.0)

    def bordered(self, border: Border, column: Column, share: float, of: Parameters) -> None:
        """Add what one column's own factors say of base and length; `border` is that column's."""
        prior, nodes = self._of_column, self.grid.nodes
        error = lie.log(lie.inverse(prior.T_map_base) @ column.T[0])
        right, left = lie.right_jacobian_inverse(error), lie.left_jacobian_inverse(error)
        back = lie.adjoint(lie.inverse(prior.T_map_base) @ self._T_map_start)
        columns = of.columns('base', [''])[0]
        W = np.diag(share * prior.base_information[0])
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
    sigma = np.array([base.sigma_position] * 3 + [np.radians(base.sigma_rotation_deg)] * 3)
    rate = np.array([BASE_TRANSVERSE_VELOCITY] * 3 + [BASE_ANGULAR_VELOCITY] * 3)
    if insertion.mode != 'fixed':
        sigma[0] = max(insertion.range[1] - insertion.range[0], 1e-3)
        rate[0] = 1.0
    along = lie.exp(np.array([middle, 0, 0, 0, 0, 0]))
    return base.T_map_base @ along, np.stack([sigma**-2.0, rate**-2.0])


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
    """Add the base's pose and velocity; the squared error."""
    at, velocity = work[0], column.velocity[0]
    lie_kernels.pose_error(prior.T_map_base, column.T[0], at.xi, at.right, at.scratch)
    error, J, squared = at.xi.x, at.right, 0.0
    for i in range(6):
        information = prior.base_information[0, i] * share
        rate = prior.base_information[1, i] * share
        squared += information * error[i] * error[i] + rate * velocity[i] * velocity[i]
        for j in range(6):
            weighted = information * J[i, j]
            normal.g[j] += weighted * error[i]
            for k in range(j, 6):
                normal.H[j, k] += weighted * J[i, k]
        normal.H[VELOCITY + i, VELOCITY + i] += rate
        normal.g[VELOCITY + i] += rate * velocity[i]
    return squared
