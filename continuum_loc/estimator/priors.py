"""
Prior factors of one interval.

The Gaussian process in time and in arclength, rest strain, base and bias.

An interval holds the time prior between its two columns and the factors of the *newer* column
alone (its space prior, rest strain, base); those of the very first column are in the start
message. So each factor stands once.
"""

from __future__ import annotations

from continuum_loc import lie, lie_kernels
from continuum_loc.estimator import gp
from continuum_loc.estimator.chain import Blocks, Message
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import Column, Grid, NODE_DIM, POSE, STRAIN, VELOCITY
from continuum_loc.robot import RobotDescription
from numba import njit
import numpy as np

BASE_TRANSVERSE_VELOCITY = 0.02  # [m/s] the base slides along its axis only
BASE_ANGULAR_VELOCITY = 0.02  # [rad/s]
MOVING_FACTOR = 10.0  # on the initial velocity's spread, for a body found in motion


class Priors:
    """
    The prior of a robot with given settings, on a grid.

    velocity_psd (N, 6) by node and strain_psd (N - 1, 6) by segment: the process noise.
    """

    def __init__(self, robot: RobotDescription, grid: Grid, settings: EstimatorSettings):
        prior = settings.prior
        self.grid = grid
        self.memory, self.cauchy, self.jerked = prior.memory, prior.cauchy, prior.jerked
        self.s = grid.s
        self.rest = np.array(robot.backbone.rest_strain)
        self.rest_information = 1.0 / np.square(robot.backbone.rest_strain_sigma)
        grown = (
            prior.velocity_at_base + (1.0 - prior.velocity_at_base) * (grid.s / grid.s[-1]) ** 2
        )
        self.velocity_psd = grown[:, None] * np.array(prior.velocity)
        self.velocity = 1.0 / self.velocity_psd
        self.strain_rate = 1.0 / np.array(prior.strain_rate)
        step_psd = np.square(prior.strain_step) / np.diff(grid.s)[:, None]
        self.strain_psd = np.array(prior.strain) + grid.steps[:, None] * step_psd
        self.strain = 1.0 / self.strain_psd
        self.velocity_slope = 1.0 / np.array(prior.velocity_slope)
        self.bias_rate = 1.0 / settings.gyro.bias_walk**2
        self.bias_information = 1.0 / settings.gyro.bias_sigma**2
        self.initial_velocity = np.repeat(1.0 / np.square(prior.initial_velocity_sigma), 3)
        self._set_base(robot)

    def _set_base(self, robot: RobotDescription) -> None:
        base, insertion = robot.base, robot.base.insertion
        middle = 0.0 if insertion.mode == 'fixed' else float(np.mean(insertion.range))
        self.T_map_base = base.T_map_base @ lie.exp(np.array([middle, 0, 0, 0, 0, 0]))
        sigma = np.array([base.sigma_position] * 3 + [np.radians(base.sigma_rotation_deg)] * 3)
        rate = np.array([BASE_TRANSVERSE_VELOCITY] * 3 + [BASE_ANGULAR_VELOCITY] * 3)
        if insertion.mode != 'fixed':
            sigma[0] = max(insertion.range[1] - insertion.range[0], 1e-3)
            rate[0] = 1.0
        self.base_information, self.base_rate_information = sigma**-2.0, rate**-2.0

    def start(self, column: Column, moving: bool = False) -> Message:
        """
        Return the first column's own factors, linearised there.

        They are what is known before any measurement.

        `moving` loosens the velocity, for a body found in the middle of its motion.
        """
        velocity = self.initial_velocity * (MOVING_FACTOR**-2 if moving else 1.0)
        D = self.grid.dim
        H, g = np.zeros((D, D)), np.zeros(D)
        self._add_column(H, g, column, 1.0)
        for n in range(self.grid.nodes):
            at = slice(NODE_DIM * n + VELOCITY, NODE_DIM * n + VELOCITY + 6)
            H[at, at] += np.diag(velocity)
            g[at] += velocity * column.velocity[n]
        biases = np.arange(self.grid.bias_offset, D)
        H[biases, biases] += self.bias_information
        return Message(H, g)

    def add(self, blocks: Blocks, a: Column, b: Column) -> np.ndarray:
        """
        Add the interval's time prior and the newer column's own factors; the cost too.

        Returns what the process noise of each node (N,) was multiplied by.
        """
        dt, D = b.time - a.time, self.grid.dim
        jerked = np.empty(self.grid.nodes)
        cost = _add_time(
            blocks.H,
            blocks.g,
            a.T,
            a.velocity,
            a.strain,
            b.T,
            b.velocity,
            b.strain,
            dt,
            self.velocity,
            self.strain_rate,
            self.cauchy,
            1.0 / self.jerked,
            jerked,
        )
        _add_bias(blocks.H, blocks.g, a.bias, b.bias, self.bias_rate / dt, self.grid.bias_offset)
        own = self._add_column(blocks.H[D:, D:], blocks.g[D:], b, min(dt / self.memory, 1.0))
        blocks.cost += cost + 0.5 * own
        return jerked

    def _add_column(self, H: np.ndarray, g: np.ndarray, column: Column, share: float) -> float:
        """
        Space prior, rest strain and base of one column.

        Rest strain and base pose are one observation each, not one per knot: a knot counts them by
        its `share` of the prior's memory.
        """
        squared = _add_space(
            H,
            g,
            column.T,
            column.strain,
            column.velocity,
            self.s,
            self.strain,
            self.velocity_slope,
            self.rest,
            self.rest_information * share,
        )
        return squared + _add_base(
            H,
            g,
            column.T[0],
            column.velocity[0],
            self.T_map_base,
            self.base_information * share,
            self.base_rate_information * share,
        )


@njit(cache=True)
def _add_time(
    H,
    g,
    T_a,
    v_a,
    eps_a,
    T_b,
    v_b,
    eps_b,
    dt,
    velocity_information,
    strain_information,
    cauchy,
    least,
    jerked,
):
    """
    Add each node's step from knot to knot, under a Cauchy loss; returns the robust cost.

    The noise of a step is a heavy-tailed one that all components of a node share: its variance is
    the settings' for a body that moves as usual, and grows where it is jerked, up to 1 / least;
    jerked (N,) gets by how much.
    """
    W, V, M = lie_kernels.workspace()
    e, J, index = np.empty(12), np.empty((12, 24)), np.empty(24, np.int64)
    information, walk = np.empty(6), np.empty(6)
    size = H.shape[0] // 2
    cost, c2 = 0.0, NODE_DIM * cauchy * cauchy
    for n in range(T_a.shape[0]):
        gp.motion_error(T_a[n], v_a[n], T_b[n], v_b[n], dt, e, J, W, V, M)
        squared = gp.motion_squared(e, dt, velocity_information[n])
        for i in range(6):
            walk[i] = eps_b[n, i] - eps_a[n, i]
            squared += strain_information[i] / dt * walk[i] * walk[i]
        robust = max(1.0 / (1.0 + squared / c2), least)
        jerked[n] = 1.0 / robust
        lossy = min(squared, c2 * (1.0 / least - 1.0))  # beyond it the loss is a square again
        cost += 0.5 * (c2 * np.log1p(lossy / c2) + least * (squared - lossy))
        for i in range(6):
            information[i] = robust * velocity_information[n, i]
        gp.time_index(n, VELOCITY, size, index)
        gp.add_motion(H, g, index, e, J, dt, information)
        for i in range(6):
            older = NODE_DIM * n + STRAIN + i
            newer = older + size
            weight = robust * strain_information[i] / dt
            H[older, older] += weight
            H[newer, newer] += weight
            H[older, newer] -= weight
            g[older] -= weight * walk[i]
            g[newer] += weight * walk[i]
    return cost


@njit(cache=True)
def _add_space(
    H, g, T, strain, velocity, s, strain_information, slope_information, rest, rest_information
):
    W, V, M = lie_kernels.workspace()
    e, J, index = np.empty(12), np.empty((12, 24)), np.empty(24, np.int64)
    weights = np.empty(6)
    squared = 0.0
    for n in range(T.shape[0]):
        for i in range(6):
            off = strain[n, i] - rest[i]
            row = NODE_DIM * n + STRAIN + i
            H[row, row] += rest_information[i]
            g[row] += rest_information[i] * off
            squared += rest_information[i] * off * off
        if n == T.shape[0] - 1:
            break
        ds = s[n + 1] - s[n]
        gp.motion_error(T[n], strain[n], T[n + 1], strain[n + 1], ds, e, J, W, V, M)
        _segment_index(n, STRAIN, index)
        squared += gp.add_motion(H, g, index, e, J, ds, strain_information[n])
        gp.transport_error(T[n], velocity[n], T[n + 1], velocity[n + 1], e[:6], J[:6], W, V, M)
        _segment_index(n, VELOCITY, index)
        for i in range(6):
            weights[i] = slope_information[i] / ds
        squared += gp.add_rows(H, g, index, e[:6], J[:6], weights)
    return squared


@njit(cache=True)
def _add_base(H, g, T, velocity, T_map_base, information, rate_information):
    W, V, M = lie_kernels.workspace()
    e, J = np.empty(6), np.empty((6, 6))
    lie_kernels.pose_error(T_map_base, T, e, J, W, V, M)
    squared = 0.0
    for i in range(6):
        squared += information[i] * e[i] * e[i] + rate_information[i] * velocity[i] * velocity[i]
        for j in range(6):
            weighted = information[i] * J[i, j]
            g[j] += weighted * e[i]
            for k in range(j, 6):
                H[j, k] += weighted * J[i, k]
        H[VELOCITY + i, VELOCITY + i] += rate_information[i]
        g[VELOCITY + i] += rate_information[i] * velocity[i]
    return squared


@njit(cache=True)
def _add_bias(H, g, bias_a, bias_b, weight, bias_offset):
    size = H.shape[0] // 2
    for m in range(bias_a.shape[0]):
        for i in range(3):
            older = bias_offset + 3 * m + i
            newer = older + size
            step = weight * (bias_b[m, i] - bias_a[m, i])
            H[older, older] += weight
            H[newer, newer] += weight
            H[older, newer] -= weight
            g[older] -= step
            g[newer] += step


@njit(cache=True)
def _segment_index(n, rate_offset, index):
    """Rows of [delta_n, x_n, delta_n+1, x_n+1] in a column, x the part at `rate_offset`."""
    for i in range(6):
        index[i] = NODE_DIM * n + POSE + i
        index[6 + i] = NODE_DIM * n + rate_offset + i
        index[12 + i] = NODE_DIM * (n + 1) + POSE + i
        index[18 + i] = NODE_DIM * (n + 1) + rate_offset + i
