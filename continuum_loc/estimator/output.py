"""From columns and their covariances to what is published: the body at any instant and place."""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc import lie_kernels
from continuum_loc.estimator import gp
from continuum_loc.estimator.state import Column, Grid, NODE_DIM, POSE_PART, VELOCITY_PART
from numba import njit
import numpy as np

MOTION = np.array([0, 1, 2, 3, 4, 5, 12, 13, 14, 15, 16, 17])  # a node's pose and velocity rows


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """All nodes at one instant: T (N, 4, 4), strain and velocity (N, 6)."""

    T: np.ndarray
    strain: np.ndarray
    velocity: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class BodyState:
    """
    The continuous state at one instant and arclength.

    T_map_body (4, 4), strain (6,), velocity (6,), and covariance (18, 18) of [pose, strain,
    velocity], pose perturbations on the right.
    """

    T_map_body: np.ndarray
    strain: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray


def body_between(a: Column, b: Column, time: float) -> Body:
    """
    Interpolate the body at `time` between two columns.

    Pose and velocity by the Gaussian process's cubic Hermite, strain linearly.
    """
    nodes, d = len(a.T), b.time - a.time
    T, velocity = np.empty((nodes, 4, 4)), np.empty((nodes, 6))
    _interpolate(
        a.T,
        a.velocity,
        b.T,
        b.velocity,
        d,
        np.full(nodes, time - a.time),
        np.arange(nodes),
        np.arange(nodes),
        T,
        velocity,
        np.empty((0, 6, 24)),
        np.empty((0, 6, 24)),
    )
    u = (time - a.time) / d
    return Body(T, (1.0 - u) * a.strain + u * b.strain, velocity)


def blended_step(step_a: np.ndarray, step_b: np.ndarray, d: float, tau: float) -> np.ndarray:
    """
    Pose step (N, 6) at tau between two states whose nodes step by (N, 18), to first order.

    The cubic Hermite with the relative pose taken for small.
    """
    u = tau / d
    h1, h2, h3 = u * u * (3.0 - 2.0 * u), u * (1.0 - u) * (1.0 - u) * d, u * u * (u - 1.0) * d
    return (
        (1.0 - h1) * step_a[:, POSE_PART]
        + h2 * step_a[:, VELOCITY_PART]
        + h1 * step_b[:, POSE_PART]
        + h3 * step_b[:, VELOCITY_PART]
    )


def interpolated_poses(
    a: Column, b: Column, tau: np.ndarray, nodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Poses (m, 4, 4) of `nodes` (m,) at times tau (m,) after column a, and their Jacobians.

    The Jacobians (m, 6, 24) are by [delta_a, v_a, delta_b, v_b] of the node.
    """
    m = len(nodes)
    T, J_pose = np.empty((m, 4, 4)), np.empty((m, 6, 24))
    _interpolate(
        a.T,
        a.velocity,
        b.T,
        b.velocity,
        b.time - a.time,
        tau,
        nodes,
        nodes,
        T,
        np.empty((m, 6)),
        J_pose,
        np.empty((m, 6, 24)),
    )
    return T, J_pose


def motion_jacobians(
    a: Column, b: Column, time: float, nodes: np.ndarray, dim: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Jacobians A, B (12 m, D) of [pose, velocity] of `nodes` (m,) at `time`.

    They are by the offsets of the two columns.
    """
    m, d, tau = len(nodes), b.time - a.time, time - a.time
    J = np.empty((m, 12, 24))
    _interpolate(
        a.T,
        a.velocity,
        b.T,
        b.velocity,
        d,
        np.full(m, tau),
        nodes,
        nodes,
        np.empty((m, 4, 4)),
        np.empty((m, 6)),
        J[:, :6],
        J[:, 6:],
    )
    out = np.zeros((2, m, 12, dim))
    for i, node in enumerate(nodes):
        out[:, i, :, NODE_DIM * node + MOTION] = J[i].reshape(12, 2, 12).transpose(2, 1, 0)
    return out[0].reshape(12 * m, dim), out[1].reshape(12 * m, dim)


def motion_bridge(a: Column, b: Column, time: float, velocity_psd: np.ndarray) -> np.ndarray:
    """
    Covariance (m, 12, 12) of [pose, velocity] at `time` that the two columns leave open.

    velocity_psd: (m, 6) process noise of the nodes.
    """
    open_bridge = np.empty((2, 2))
    gp.bridge(time - a.time, b.time - a.time, open_bridge)
    return np.kron(open_bridge, velocity_psd[:, :, None] * np.eye(6))


def rattle_covariance(s_imu: np.ndarray, turns: np.ndarray, s: np.ndarray) -> np.ndarray:
    """
    Covariance (m, 6, 6) at arclengths s (m,) of a motion too fast for the knots.

    turns: (I, 3) its standard deviation about each axis at IMUs s_imu (I,), which increase [rad].
    The clamped base does not rattle, and turns move what is beyond them sideways: the lateral
    deviations are the turns' integrals along the body, as for one mode of bending.
    """
    covariance = np.zeros((len(s), 6, 6))
    _rattle(s_imu, turns, s, covariance)
    return covariance


@njit(cache=True)
def _rattle(s_imu, turns, s, covariance):
    at, turn, shift = (
        np.zeros(len(s_imu) + 1),
        np.zeros((3, len(s_imu) + 1)),
        np.zeros((3, len(s_imu) + 1)),
    )
    at[1:], turn[:, 1:] = s_imu, turns.T
    for m in range(1, len(at)):
        shift[:, m] = shift[:, m - 1] + 0.5 * (at[m] - at[m - 1]) * (turn[:, m] + turn[:, m - 1])
    for i in range(3):
        covariance[:, 3 + i, 3 + i] = np.square(np.interp(s, at, turn[i]))
    covariance[:, 1, 1] = np.square(np.interp(s, at, shift[2]))
    covariance[:, 2, 2] = np.square(np.interp(s, at, shift[1]))


@njit(cache=True)
def _interpolate(T_a, v_a, T_b, v_b, d, tau, from_a, from_b, T, v, J_pose, J_rate):
    """
    `gp.hermite` for many: element m goes from T_a[from_a[m]] to T_b[from_b[m]] at tau[m].

    The Jacobians are written where J_pose has room.
    """
    W, V, M = lie_kernels.workspace()
    rows = 6 if J_pose.shape[0] > 0 else 0
    J_work, pose, rate = np.empty((2, 6, 24)), np.empty((rows, 24)), np.empty((rows, 24))
    for m in range(tau.shape[0]):
        a, b = from_a[m], from_b[m]
        gp.hermite(
            T_a[a], v_a[a], T_b[b], v_b[b], d, tau[m], T[m], v[m], pose, rate, W, V, M, J_work
        )
        if m < J_pose.shape[0]:
            J_pose[m] = pose
            J_rate[m] = rate


def backbone(grid: Grid, T: np.ndarray, strain: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) at arclengths s (B,) of a body with nodes T (N, 4, 4) and strain (N, 6)."""
    out = np.empty((len(s), 4, 4))
    _backbone(T, strain, grid.s, *grid.segments(s), out)
    return out


@njit(cache=True)
def _backbone(T, strain, s, segments, offsets, out):
    W, V, M = lie_kernels.workspace()
    related = -1
    for m in range(segments.shape[0]):
        n = segments[m]
        if n != related:
            gp.relate(T[n], T[n + 1], strain[n + 1], W, V, M)
            related = n
        gp.pose_at(T[n], strain[n], s[n + 1] - s[n], offsets[m], out[m], V, M)
