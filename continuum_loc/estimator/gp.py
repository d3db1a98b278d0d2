"""
Gaussian process on SE(3), the same in time and in arclength: interpolation and prior, compiled.

White noise drives the derivative of the body-frame rate v (the velocity in time, the strain in
arclength). Between two states a and b, d apart, with xi = Log(T_a^-1 T_b) and w = J_r(xi)^-1 v_b:

- mean: cubic Hermite in the local variable, gamma(tau) = h1 xi + h2 v_a + h3 w, T(tau) = T_a
  Exp(gamma), v(tau) = J_r(gamma) gamma';
- prior: e = [xi - d v_a; w - v_a] with covariance [[d^3/3, d^2/2], [d^2/2, d]] (x) diag(q).

Columns of every Jacobian of two states: [delta_a, v_a, delta_b, v_b], right perturbations of the
poses. `relate` two states once, then `evaluate` between them any number of times.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie_kernels as lk
from continuum_loc.compiling import kernel
import numpy as np


class Ends(NamedTuple):
    """Two states of the process, `span` apart: poses (4, 4) and rates (6,)."""

    T_a: np.ndarray
    v_a: np.ndarray
    T_b: np.ndarray
    v_b: np.ndarray
    span: float


class Instant(NamedTuple):
    """A state between two: T (4, 4), v (6,), and their Jacobians (6, 24)."""

    T: np.ndarray
    v: np.ndarray
    J_pose: np.ndarray
    J_rate: np.ndarray


# What the functions here leave for one another, and what `evaluate` finds.
_SQUARE = (6, 6)
WORKSPACE = np.dtype(
    [
        # Two states, and how b lies from a.
        ('T_a', float, (4, 4)),
        ('v_a', float, 6),
        ('span', float),
        ('xi', lk.TWIST),  # with the series of J_r(xi)^-1
        ('w', float, 6),
        ('right', float, _SQUARE),  # J_r(xi)^-1
        ('left', float, _SQUARE),  # J_l(xi)^-1
        ('w_by_xi', float, _SQUARE),
        ('w_by_b', float, _SQUARE),
        ('w_by_a', float, _SQUARE),  # but for the sign
        # The local variable at one tau.
        ('gamma', lk.TWIST),  # with the series of J_r(gamma)
        ('slope', float, 6),  # gamma'
        ('weights', float, 6),  # of xi, v_a and w: three for gamma, three for gamma'
        ('right_gamma', float, _SQUARE),  # J_r(gamma)
        ('v_by_gamma', float, _SQUARE),
        ('gamma_by_ends', float, (6, 24)),
        ('slope_by_ends', float, (6, 24)),
        ('step', float, (4, 4)),  # Exp(gamma)
        ('back', float, (4, 4)),  # T^-1 T_a
        ('Ad_back', float, _SQUARE),
        # The state there.
        ('T', float, (4, 4)),
        ('v', float, 6),
        ('J_pose', float, (6, 24)),
        ('J_rate', float, (6, 24)),
        ('scratch', lk.SCRATCH),
    ]
)


def new_workspace() -> np.ndarray:
    """One WORKSPACE; kernels get it from Python, as a record does not keep its array alive."""
    return np.zeros(1, WORKSPACE)


@kernel
def relate(ends, work):
    """Leave two states, and how b lies from a, in the workspace."""
    at = work[0]
    xi, scratch, right, left = at.xi, at.scratch, at.right, at.left
    at.span = ends.span
    for i in range(6):
        at.v_a[i] = ends.v_a[i]
    for i in range(4):
        for j in range(4):
            at.T_a[i, j] = ends.T_a[i, j]
    lk.relative(ends.T_a, ends.T_b, scratch.pose)
    lk.log(scratch.pose, xi.x)
    lk.ad(xi.x, xi.ad)
    lk.right_inverse_coefficients(xi.x, xi.c, xi.dc)
    lk.polynomial(xi.c, xi.ad, right, scratch.blocks)
    lk.polynomial_times(xi, ends.v_b, at.w, at.w_by_xi, scratch)
    for i in range(6):
        for j in range(6):
            left[i, j] = right[i, j] - xi.ad[i, j]  # J_l^-1 = J_r^-1 - ad(xi)
    lk.product(at.w_by_xi, right, at.w_by_b)
    lk.product(at.w_by_xi, left, at.w_by_a)


@kernel
def _by_ends(by_xi, by_a, by_w, work, J):
    """J (6, 24) of by_xi xi + by_a v_a + by_w w."""
    at = work[0]
    left, right, w_by_a, w_by_b = at.left, at.right, at.w_by_a, at.w_by_b
    for i in range(6):
        for j in range(6):
            J[i, j] = -(by_xi * left[i, j] + by_w * w_by_a[i, j])
            J[i, 6 + j] = 0.0
            J[i, 12 + j] = by_xi * right[i, j] + by_w * w_by_b[i, j]
            J[i, 18 + j] = by_w * right[i, j]
        J[i, 6 + i] = by_a


@kernel
def evaluate(work, tau, pose, first):
    """
    Find the state at tau in [0, span] between two that `relate` left in the workspace.

    T, v, J_pose where `pose` says so, and the rows of J_rate from `first` on (6: none).
    """
    rate_at(work, tau)
    at = work[0]
    h, gamma = at.weights, at.gamma
    _by_ends(h[0], h[1], h[2], work, at.gamma_by_ends)
    lk.exp(gamma.x, at.step)
    lk.compose(at.T_a, at.step, at.T)
    lk.polynomial(gamma.c, gamma.ad, at.right_gamma, at.scratch.blocks)
    if pose:
        lk.relative(at.T, at.T_a, at.back)
        lk.adjoint(at.back, at.Ad_back)
        for i in range(6):
            for j in range(24):
                at.J_pose[i, j] = at.Ad_back[i, j] if j < 6 else 0.0
        _add_product(at.right_gamma, at.gamma_by_ends, 0, at.J_pose)
    if first < 6:
        _by_ends(h[3], h[4], h[5], work, at.slope_by_ends)
        at.J_rate[first:] = 0.0
        _add_product(at.v_by_gamma, at.gamma_by_ends, first, at.J_rate)
        _add_product(at.right_gamma, at.slope_by_ends, first, at.J_rate)


@kernel
def _add_product(A, B, first, out):
    """Add A (6, 6) B (6, 24) to out, from row `first` on."""
    for i in range(first, 6):
        for k in range(6):  # the innermost loop is over neighbours in memory
            scale = A[i, k]
            for j in range(24):
                out[i, j] += scale * B[k, j]


@kernel
def _place(work, tau):
    """Find gamma and its derivative at tau."""
    at = work[0]
    d, h, x, slope = at.span, at.weights, at.gamma.x, at.slope
    u, xi, w, v_a = tau / d, at.xi.x, at.w, at.v_a
    h[0] = u * u * (3.0 - 2.0 * u)
    h[1] = u * (1.0 - u) * (1.0 - u) * d
    h[2] = u * u * (u - 1.0) * d
    h[3] = 6.0 * u * (1.0 - u) / d
    h[4] = (1.0 - u) * (1.0 - 3.0 * u)
    h[5] = u * (3.0 * u - 2.0)
    for i in range(6):
        x[i] = h[0] * xi[i] + h[1] * v_a[i] + h[2] * w[i]
        slope[i] = h[3] * xi[i] + h[4] * v_a[i] + h[5] * w[i]


@kernel
def pose_at(work, tau):
    """Find T alone, between two states that `relate` left in the workspace."""
    _place(work, tau)
    at = work[0]
    lk.exp(at.gamma.x, at.step)
    lk.compose(at.T_a, at.step, at.T)


@kernel
def rate_at(work, tau):
    """Find v alone, between two states that `relate` left in the workspace."""
    _place(work, tau)
    at = work[0]
    gamma = at.gamma
    lk.ad(gamma.x, gamma.ad)
    lk.right_coefficients(gamma.x, gamma.c, gamma.dc)
    lk.polynomial_times(gamma, at.slope, at.v, at.v_by_gamma, at.scratch)


@kernel
def motion_error(ends, e, J, work):
    """Prior error e (12,) = [xi - d v_a; w - v_a] and its Jacobian J (12, 24)."""
    relate(ends, work)
    at, d = work[0], ends.span
    for i in range(6):
        e[i] = at.xi.x[i] - d * ends.v_a[i]
        e[6 + i] = at.w[i] - ends.v_a[i]
    _by_ends(1.0, -d, 0.0, work, J[:6])
    _by_ends(0.0, -1.0, 1.0, work, J[6:])


@kernel
def transport_error(ends, e, J, work):
    """
    How a rate varies from a to b: e (6,) = v_b - Ad(T_b^-1 T_a) v_a and its Jacobian J (6, 24).

    The adjoint is exact: a first-order transport is 14 % wrong at 0.12 m and 5 1/m.
    """
    scratch = work[0].scratch
    Ad, carried = scratch.matrix, scratch.powers[0]
    ad, turned = scratch.blocks[0], scratch.blocks[1]
    lk.relative(ends.T_b, ends.T_a, scratch.pose)
    lk.adjoint(scratch.pose, Ad)
    lk.apply(Ad, ends.v_a, carried)
    lk.ad(ends.v_a, ad)
    lk.block_product(Ad, ad, turned)
    lk.ad(carried, ad)
    for i in range(6):
        e[i] = ends.v_b[i] - carried[i]
        for j in range(6):
            J[i, j] = turned[i, j]
            J[i, 6 + j] = -Ad[i, j]
            J[i, 12 + j] = -ad[i, j]
            J[i, 18 + j] = 1.0 if i == j else 0.0


@kernel
def bridge(tau, d):
    """
    Covariance (2, 2) of (pose, rate) at tau given both ends, per unit of q.

    Q(tau) - Q(tau) Phi^T Q(d)^-1 Phi Q(tau), with Phi = [[1, d - tau], [0, 1]].
    """
    q11, q12, q22 = tau**3 / 3.0, tau**2 / 2.0, tau
    r = d - tau
    a11, a12 = q11 + r * q12, q12  # Q Phi^T, first row
    a21, a22 = q12 + r * q22, q22
    i11, i12, i22 = 12.0 / d**3, -6.0 / d**2, 4.0 / d
    b11, b12 = i11 * a11 + i12 * a12, i12 * a11 + i22 * a12
    b21, b22 = i11 * a21 + i12 * a22, i12 * a21 + i22 * a22
    out = np.empty((2, 2))
    out[0, 0] = q11 - (a11 * b11 + a12 * b12)
    out[0, 1] = out[1, 0] = q12 - (a11 * b21 + a12 * b22)
    out[1, 1] = q22 - (a21 * b21 + a22 * b22)
    return out


@kernel
def motion_squared(e, d, q_inverse):
    """Squared error e^T Q(d)^-1 (x) diag(q)^-1 e of `motion_error`'s e (12,)."""
    a, b, c = 12.0 / d**3, -6.0 / d**2, 4.0 / d
    squared = 0.0
    for i in range(6):
        squared += q_inverse[i] * (
            a * e[i] * e[i] + 2.0 * b * e[i] * e[6 + i] + c * e[6 + i] * e[6 + i]
        )
    return squared


@kernel
def add_motion(normal, index, e, J, d, q_inverse):
    """
    Add the prior's normal equations at the 24 rows `index`; returns the squared error.

    The information is Q(d)^-1 (x) diag(q)^-1 with Q(d)^-1 = [[12/d^3, -6/d^2], [-6/d^2, 4/d]].
    """
    H, g = normal.H, normal.g
    a, b, c = 12.0 / d**3, -6.0 / d**2, 4.0 / d
    squared = 0.0
    for i in range(6):
        upper, lower, q = J[i], J[6 + i], q_inverse[i]
        eu, el = q * (a * e[i] + b * e[6 + i]), q * (b * e[i] + c * e[6 + i])
        squared += e[i] * eu + e[6 + i] * el
        for j in range(24):
            wu, wl = q * (a * upper[j] + b * lower[j]), q * (b * upper[j] + c * lower[j])
            if wu == 0.0 and wl == 0.0:
                continue
            row = index[j]
            g[row] += upper[j] * eu + lower[j] * el
            for k in range(j, 24):
                H[row, index[k]] += wu * upper[k] + wl * lower[k]
    return squared


def interpolate(ends: Ends, tau: float) -> Instant:
    """State at tau between two others."""
    work = new_workspace()
    relate(ends, work)
    evaluate(work, tau, True, 0)
    at = work[0]
    return Instant(at['T'], at['v'], at['J_pose'], at['J_rate'])
