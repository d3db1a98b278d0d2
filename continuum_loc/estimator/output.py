"""From columns and their covariances to what is published: the body at any instant and arclength."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from continuum_loc import lie_kernels
from continuum_loc.estimator import gp
from continuum_loc.estimator.state import NODE_DIM, POSE, STRAIN, VELOCITY, Column, Grid


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """All nodes at one instant: T (N, 4, 4), strain and velocity (N, 6), and the joint covariance of the column's
    node part, (N, 18, 18) each node's own in [pose, strain, velocity] order."""

    T: np.ndarray
    strain: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray


def body_between(a: Column, b: Column, P_a: np.ndarray, P_ab: np.ndarray, P_b: np.ndarray, time: float,
                 velocity_psd: np.ndarray, strain_psd: np.ndarray) -> Body:
    """The body at `time` between two columns, whose covariances (D, D) are P_a, P_b and cross covariance P_ab.

    Pose and velocity are the Gaussian process's cubic Hermite, strain its linear interpolation; the covariance
    includes the bridge that the two ends leave open.
    """
    nodes = len(a.T)
    T, strain, velocity = np.empty((nodes, 4, 4)), np.empty((nodes, 6)), np.empty((nodes, 6))
    covariance = np.zeros((nodes, NODE_DIM, NODE_DIM))
    _between(a.T, a.strain, a.velocity, b.T, b.strain, b.velocity, P_a, P_ab, P_b, time - a.time, b.time - a.time,
             velocity_psd, strain_psd, T, strain, velocity, covariance)
    return Body(T, strain, velocity, covariance)


def body_at(column: Column, P: np.ndarray) -> Body:
    """The body at a knot itself."""
    blocks = [P[NODE_DIM * n:NODE_DIM * (n + 1), NODE_DIM * n:NODE_DIM * (n + 1)] for n in range(len(column.T))]
    return Body(column.T, column.strain, column.velocity, np.array(blocks))


@njit(cache=True)
def _between(T_a, eps_a, v_a, T_b, eps_b, v_b, P_a, P_ab, P_b, tau, d, velocity_psd, strain_psd, T, strain, velocity,
             covariance):
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    J = np.zeros((NODE_DIM, 2 * NODE_DIM))
    J_pose, J_rate = np.empty((6, 24)), np.empty((6, 24))
    P = np.empty((2 * NODE_DIM, 2 * NODE_DIM))
    open_bridge = np.empty((2, 2))
    gp.bridge(tau, d, open_bridge)
    u = tau / d
    for n in range(T_a.shape[0]):
        gp.hermite(T_a[n], v_a[n], T_b[n], v_b[n], d, tau, T[n], velocity[n], J_pose, J_rate, W, V, M, J_work)
        at = NODE_DIM * n
        for i in range(NODE_DIM):
            for j in range(NODE_DIM):
                P[i, j] = P_a[at + i, at + j]
                P[NODE_DIM + i, NODE_DIM + j] = P_b[at + i, at + j]
                P[i, NODE_DIM + j] = P_ab[at + i, at + j]
                P[NODE_DIM + j, i] = P_ab[at + i, at + j]
        for i in range(6):
            strain[n, i] = (1.0 - u) * eps_a[n, i] + u * eps_b[n, i]
            J[STRAIN + i, STRAIN + i] = 1.0 - u
            J[STRAIN + i, NODE_DIM + STRAIN + i] = u
            for j in range(6):
                J[POSE + i, POSE + j] = J_pose[i, j]
                J[POSE + i, VELOCITY + j] = J_pose[i, 6 + j]
                J[POSE + i, NODE_DIM + POSE + j] = J_pose[i, 12 + j]
                J[POSE + i, NODE_DIM + VELOCITY + j] = J_pose[i, 18 + j]
                J[VELOCITY + i, POSE + j] = J_rate[i, j]
                J[VELOCITY + i, VELOCITY + j] = J_rate[i, 6 + j]
                J[VELOCITY + i, NODE_DIM + POSE + j] = J_rate[i, 12 + j]
                J[VELOCITY + i, NODE_DIM + VELOCITY + j] = J_rate[i, 18 + j]
        covariance[n] = J @ P @ J.T
        for i in range(6):
            covariance[n, POSE + i, POSE + i] += open_bridge[0, 0] * velocity_psd[i]
            covariance[n, VELOCITY + i, VELOCITY + i] += open_bridge[1, 1] * velocity_psd[i]
            covariance[n, POSE + i, VELOCITY + i] += open_bridge[0, 1] * velocity_psd[i]
            covariance[n, VELOCITY + i, POSE + i] += open_bridge[0, 1] * velocity_psd[i]
            covariance[n, STRAIN + i, STRAIN + i] += u * (1.0 - u) * d * strain_psd[i]


def backbone(grid: Grid, T: np.ndarray, strain: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Poses (B, 4, 4) at arclengths s (B,) of a body with nodes T (N, 4, 4) and strain (N, 6)."""
    segments = [grid.segment(x) for x in s]
    out = np.empty((len(s), 4, 4))
    _backbone(T, strain, grid.s, np.array([n for n, _ in segments]), np.array([offset for _, offset in segments]), out)
    return out


@njit(cache=True)
def _backbone(T, strain, s, segments, offsets, out):
    W, V, M = lie_kernels.workspace()
    J_pose, J_rate, J_work, rate = np.empty((6, 24)), np.empty((6, 24)), np.empty((2, 6, 24)), np.empty(6)
    for m in range(segments.shape[0]):
        n = segments[m]
        gp.hermite(T[n], strain[n], T[n + 1], strain[n + 1], s[n + 1] - s[n], offsets[m], out[m], rate, J_pose, J_rate,
                   W, V, M, J_work)
