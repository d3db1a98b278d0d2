"""The body at any instant and place, from columns and their covariances."""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc.compiling import kernel
from continuum_loc.estimator import gp
from continuum_loc.estimator.state import (
    Column,
    ends_along,
    ends_in_time,
    Grid,
    NODE_DIM,
    POSE_PART,
    VELOCITY_PART,
)
import numpy as np

_WORK = gp.new_workspace()  # of kernels that run one at a time, and leave nothing in it
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
    nodes, u = np.arange(len(a.T)), (time - a.time) / (b.time - a.time)
    found = interpolated(a, b, np.full(len(nodes), time - a.time), nodes)
    return Body(found.T, (1.0 - u) * a.strain + u * b.strain, found.v)


def interpolated(
    a: Column,
    b: Column,
    tau: np.ndarray,
    nodes: np.ndarray,
    pose: bool = False,
    rate: bool = False,
) -> gp.Instant:
    """
    States of `nodes` (m,) at times tau (m,) after column a, each field with m in front.

    The Jacobians, of the pose and of the rate as asked for, are by [delta_a, v_a, delta_b, v_b] of
    the node.
    """
    m = len(nodes)
    out = gp.Instant(
        np.empty((m, 4, 4)),
        np.empty((m, 6)),
        np.empty((m if pose else 0, 6, 24)),
        np.empty((m if rate else 0, 6, 24)),
    )
    _interpolate(a, b, tau, nodes, out, _WORK)
    return out


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


def motion_jacobians(
    a: Column, b: Column, time: float, nodes: np.ndarray, dim: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Jacobians A, B (12 m, D) of [pose, velocity] of `nodes` (m,) at `time`.

    They are by the offsets of the two columns.
    """
    m = len(nodes)
    found = interpolated(a, b, np.full(m, time - a.time), nodes, pose=True, rate=True)
    J = np.concatenate([found.J_pose, found.J_rate], axis=1)
    out = np.zeros((2, m, 12, dim))
    for i, node in enumerate(nodes):
        out[:, i, :, NODE_DIM * node + MOTION] = J[i].reshape(12, 2, 12).transpose(2, 1, 0)
    return out[0].reshape(12 * m, dim), out[1].reshape(12 * m, dim)


def motion_bridge(a: Column, b: Column, time: float, velocity_psd: np.ndarray) -> np.ndarray:
    """
    Covariance (m, 12, 12) of [pose, velocity] at `time` that the two columns leave open.

    velocity_psd: (m, 6) process noise of the nodes.
    """
    open_ = gp.bridge(time - a.time, b.time - a.time)
    return np.kron(open_, velocity_psd[:, :, None] * np.eye(6))


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


@kernel
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


@kernel
def _interpolate(a, b, tau, nodes, out, work):
    pose, rate = out.J_pose.shape[0] > 0, out.J_rate.shape[0] > 0
    for m in range(tau.shape[0]):
        gp.relate(ends_in_time(a, b, nodes[m]), work)
        gp.evaluate(work, tau[m], pose, 0 if rate else 6)
        at = work[0]
        out.T[m], out.v[m] = at.T, at.v
        if pose:
            out.J_pose[m] = at.J_pose
        if rate:
            out.J_rate[m] = at.J_rate


def backbone(grid: Grid, T: np.ndarray, strain: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) at arclengths s (B,) of a body with nodes T (N, 4, 4) and strain (N, 6)."""
    out = np.empty((len(s), 4, 4))
    _backbone(T, strain, grid.s, *grid.segments(s), out, _WORK)
    return out


@kernel
def _backbone(T, strain, s, segments, offsets, out, work):
    related = -1
    for m in range(segments.shape[0]):
        if segments[m] != related:
            related = segments[m]
            gp.relate(ends_along(T, strain, s, related), work)
        gp.pose_at(work, offsets[m])
        out[m] = work[0].T
