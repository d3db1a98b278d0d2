"""
Gaussian process on SE(3), the same in time and in arclength.

Interpolation and prior factors, compiled.

White noise drives the derivative of the body-frame rate v (the velocity in time, the strain in
arclength), so between two states a and b, d apart, with xi = Log(T_a^-1 T_b) and w = J_r(xi)^-1
v_b:

- mean: cubic Hermite in the local variable, gamma(tau) = h1 xi + h2 v_a + h3 w, T(tau) = T_a
  Exp(gamma), v(tau) = J_r(gamma) gamma';
- prior: e = [xi - d v_a; w - v_a] with covariance [[d^3/3, d^2/2], [d^2/2, d]] (x) diag(q).

Columns of every Jacobian of two states: [delta_a, v_a, delta_b, v_b], right perturbations of the
poses.
"""

from __future__ import annotations

from continuum_loc import lie_kernels as lk
from numba import njit
import numpy as np


@njit(cache=True)
def relate(T_a, T_b, v_b, W, V, M):
    """
    Relative pose's logarithm and rate, with what their Jacobians are made of.

    xi in V[0], w = J_r(xi)^-1 v_b in V[3]; J_r(xi)^-1 in W[1], J_l(xi)^-1 in W[2], dw/dxi in W[3]
    and its products with those two in W[4] and W[5].
    """
    lk.relative(T_a, T_b, M[0])
    lk.log(M[0], V[0])
    lk.ad(V[0], W[0])
    lk.right_inverse_coefficients(V[0], V[1], V[2])
    lk.polynomial(V[1], W[0], W[1], W[6:8])
    lk.polynomial_times(V[1], V[2], V[0], W[0], v_b, V[3], W[3], W[6:8], V[4:9])
    for i in range(6):
        for j in range(6):
            W[2, i, j] = W[1, i, j] - W[0, i, j]  # J_l^-1 = J_r^-1 - ad(xi)
    lk.product(W[3], W[1], W[4])
    lk.product(W[3], W[2], W[5])


@njit(cache=True)
def _chain_rate(scale_xi, scale_a, scale_w, W, J):
    """J (6, 24) of scale_xi xi + scale_a v_a + scale_w w, from the W of `relate`."""
    for i in range(6):
        for j in range(6):
            J[i, j] = -(scale_xi * W[2, i, j] + scale_w * W[5, i, j])
            J[i, 6 + j] = 0.0
            J[i, 12 + j] = scale_xi * W[1, i, j] + scale_w * W[4, i, j]
            J[i, 18 + j] = scale_w * W[1, i, j]
        J[i, 6 + i] = scale_a


@njit(cache=True)
def hermite(T_a, v_a, T_b, v_b, d, tau, T, v, J_pose, J_rate, W, V, M, J_work):
    """
    Interpolate at tau in [0, d]: T (4, 4), v (6,), and their Jacobians J_pose, J_rate (6, 24).

    W, V, M come from `lie_kernels.workspace`, J_work is (2, 6, 24).
    """
    relate(T_a, T_b, v_b, W, V, M)
    evaluate(T_a, v_a, d, tau, T, v, J_pose, J_rate, W, V, M, J_work)


@njit(cache=True)
def evaluate(T_a, v_a, d, tau, T, v, J_pose, J_rate, W, V, M, J_work):
    """
    `hermite` between two states that `relate` left in the workspace: any number of times.

    J_rate may be that of the last r components alone (r, 24), and a Jacobian without rows is left
    out.
    """
    rate_at(v_a, d, tau, v, W, V)
    by_gamma, by_rate, h = J_work[0], J_work[1], V[13]
    _chain_rate(h[0], h[1], h[2], W, by_gamma)
    _advance(T_a, T, V, M)
    lk.polynomial(V[11], W[6], W[8], W[9:11])
    if J_pose.shape[0] > 0:
        lk.relative(T, T_a, M[2])
        lk.adjoint(M[2], W[9])
        for i in range(6):
            for j in range(24):
                J_pose[i, j] = W[9, i, j] if j < 6 else 0.0
        _add_product(W[8], by_gamma, J_pose)
    if J_rate.shape[0] > 0:
        _chain_rate(h[3], h[4], h[5], W, by_rate)
        J_rate[:, :] = 0.0
        first = 6 - J_rate.shape[0]
        _add_product(W[7, first:], by_gamma, J_rate)
        _add_product(W[8, first:], by_rate, J_rate)


@njit(cache=True)
def _add_product(A, B, out):
    """Add A (r, 6) B (6, 24) to out."""
    for i in range(A.shape[0]):
        for k in range(6):  # the innermost loop is over neighbours in memory
            scale = A[i, k]
            for j in range(24):
                out[i, j] += scale * B[k, j]


@njit(cache=True)
def _local(v_a, d, tau, V):
    """
    Gamma into V[9] and its derivative into V[10], from what `relate` left in V.

    The weights of xi, v_a and w go to V[13]: three for gamma, three for its derivative.
    """
    u, h = tau / d, V[13]
    h[0], h[1], h[2] = (
        u * u * (3.0 - 2.0 * u),
        u * (1.0 - u) * (1.0 - u) * d,
        u * u * (u - 1.0) * d,
    )
    h[3], h[4], h[5] = 6.0 * u * (1.0 - u) / d, (1.0 - u) * (1.0 - 3.0 * u), u * (3.0 * u - 2.0)
    for i in range(6):
        V[9, i] = h[0] * V[0, i] + h[1] * v_a[i] + h[2] * V[3, i]
        V[10, i] = h[3] * V[0, i] + h[4] * v_a[i] + h[5] * V[3, i]


@njit(cache=True)
def _advance(T_a, T, V, M):
    """T = T_a Exp(gamma), gamma from V[9]."""
    lk.exp(V[9], M[1])
    lk.compose(T_a, M[1], T)


@njit(cache=True)
def pose_at(T_a, v_a, d, tau, T, V, M):
    """Pose T (4, 4) alone, between two states that `relate` left in the workspace."""
    _local(v_a, d, tau, V)
    _advance(T_a, T, V, M)


@njit(cache=True)
def rate_at(v_a, d, tau, v, W, V):
    """
    Rate v (6,) alone, between two states that `relate` left in the workspace.

    Leaves gamma in V[9], ad(gamma) in W[6], the derivative of J_r(gamma) gamma' by gamma in W[7],
    the coefficients of J_r in V[11] and the weights in V[13].
    """
    _local(v_a, d, tau, V)
    gamma, rate = V[9], V[10]
    lk.ad(gamma, W[6])
    lk.right_coefficients(gamma, V[11], V[12])
    lk.polynomial_times(V[11], V[12], gamma, W[6], rate, v, W[7], W[8:10], V[4:9])


@njit(cache=True)
def motion_error(T_a, v_a, T_b, v_b, d, e, J, W, V, M):
    """Prior error e (12,) = [xi - d v_a; w - v_a] and its Jacobian J (12, 24)."""
    relate(T_a, T_b, v_b, W, V, M)
    for i in range(6):
        e[i] = V[0, i] - d * v_a[i]
        e[6 + i] = V[3, i] - v_a[i]
    _chain_rate(1.0, -d, 0.0, W, J[:6])
    _chain_rate(0.0, -1.0, 1.0, W, J[6:])


@njit(cache=True)
def transport_error(T_a, x_a, T_b, x_b, e, J, W, V, M):
    """
    How a rate varies across a segment: e (6,) = x_b - Ad(T_b^-1 T_a) x_a.

    J (6, 24) by [delta_a, x_a, delta_b, x_b].

    The adjoint is exact: a first-order transport is 14 % wrong at 0.12 m and 5 1/m.
    """
    lk.relative(T_b, T_a, M[0])
    lk.adjoint(M[0], W[0])
    lk.apply(W[0], x_a, V[0])
    lk.ad(V[0], W[1])
    lk.ad(x_a, W[2])
    lk.block_product(W[0], W[2], W[3])
    for i in range(6):
        e[i] = x_b[i] - V[0, i]
        for j in range(6):
            J[i, j] = W[3, i, j]
            J[i, 6 + j] = -W[0, i, j]
            J[i, 12 + j] = -W[1, i, j]
            J[i, 18 + j] = 1.0 if i == j else 0.0


@njit(cache=True)
def bridge(tau, d, out):
    """
    Out (2, 2): covariance of (pose, rate) at tau given both ends, per unit of q.

    Q(tau) - Q(tau) Phi(d, tau)^T Q(d)^-1 Phi(d, tau) Q(tau), with Phi(d, tau) = [[1, d - tau], [0,
    1]].
    """
    q11, q12, q22 = tau**3 / 3.0, tau**2 / 2.0, tau
    r = d - tau
    a11, a12 = q11 + r * q12, q12  # Q Phi^T, first row
    a21, a22 = q12 + r * q22, q22
    i11, i12, i22 = 12.0 / d**3, -6.0 / d**2, 4.0 / d
    b11, b12 = i11 * a11 + i12 * a12, i12 * a11 + i22 * a12
    b21, b22 = i11 * a21 + i12 * a22, i12 * a21 + i22 * a22
    out[0, 0] = q11 - (a11 * b11 + a12 * b12)
    out[0, 1] = out[1, 0] = q12 - (a11 * b21 + a12 * b22)
    out[1, 1] = q22 - (a21 * b21 + a22 * b22)


@njit(cache=True)
def motion_squared(e, d, q_inverse):
    """Squared error e^T Q(d)^-1 (x) diag(q)^-1 e of `motion_error`'s e (12,)."""
    a, b, c = 12.0 / d**3, -6.0 / d**2, 4.0 / d
    squared = 0.0
    for i in range(6):
        squared += q_inverse[i] * (
            a * e[i] * e[i] + 2.0 * b * e[i] * e[6 + i] + c * e[6 + i] * e[6 + i]
        )
    return squared


@njit(cache=True)
def add_motion(H, g, index, e, J, d, q_inverse):
    """
    Add the prior's normal equations to H, g at the 24 rows `index`; returns the squared error.

    Like all that adds to H it adds to the upper triangle, so that `index` has to increase.

    The information is Q(d)^-1 (x) diag(q)^-1 with Q(d)^-1 = [[12/d^3, -6/d^2], [-6/d^2, 4/d]].
    """
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


@njit(cache=True)
def add_rows(H, g, index, e, J, weights):
    """Add sum_i weights_i (e_i + J_i x)^2 / 2 to H, g at the rows `index`; the squared error."""
    squared = 0.0
    for i in range(e.shape[0]):
        weight = weights[i]
        squared += weight * e[i] * e[i]
        for j in range(index.shape[0]):
            scaled = weight * J[i, j]
            if scaled == 0.0:
                continue
            g[index[j]] += scaled * e[i]
            for k in range(j, index.shape[0]):
                H[index[j], index[k]] += scaled * J[i, k]
    return squared


@njit(cache=True)
def gather(H_sum, g_sum, H_local, g_local, J, work):
    """
    Add a local information block (m, m), (m,), chained through J (m, n), to H_sum (n, n), g_sum.

    Of H_sum only the upper triangle.

    For many measurements of the same states, before one `scatter`.
    """
    _weigh(H_local, J, work)
    m, n = J.shape
    for j in range(n):
        for i in range(m):
            slope = J[i, j]
            if slope == 0.0:
                continue
            g_sum[j] += slope * g_local[i]
            for k in range(j, n):
                H_sum[j, k] += slope * work[i, k]


@njit(cache=True)
def gather_rows(H_sum, g_sum, e, J):
    """Add |e + J x|^2 / 2 to H_sum (n, n), g_sum (n,), before one `scatter`."""
    for i in range(e.shape[0]):
        for j in range(J.shape[1]):
            slope = J[i, j]
            if slope == 0.0:  # as rotation is by all translation
                continue
            g_sum[j] += slope * e[i]
            for k in range(j, J.shape[1]):
                H_sum[j, k] += slope * J[i, k]


@njit(cache=True)
def scatter(H, g, index, H_sum, g_sum, weight):
    """Add weight H_sum (n, n), weight g_sum (n,) to H, g at the rows `index`, and clear them."""
    n = index.shape[0]
    for j in range(n):
        g[index[j]] += weight * g_sum[j]
        g_sum[j] = 0.0
        for k in range(j, n):
            H[index[j], index[k]] += weight * H_sum[j, k]
            H_sum[j, k] = 0.0


@njit(cache=True)
def _weigh(H_local, J, out):
    """Out (m, n) = H_local J."""
    m, n = J.shape
    for i in range(m):
        for j in range(n):
            out[i, j] = 0.0
        for k in range(m):
            weight = H_local[i, k]
            for j in range(n):
                out[i, j] += weight * J[k, j]


@njit(cache=True)
def time_index(node, rate_offset, size, index):
    """
    Rows of [delta_a, v_a, delta_b, v_b] of one node in an interval's blocks.

    rate_offset 12 is the velocity.
    """
    for i in range(6):
        index[i] = 18 * node + i
        index[6 + i] = 18 * node + rate_offset + i
        index[12 + i] = size + index[i]
        index[18 + i] = size + index[6 + i]


def interpolate(
    T_a: np.ndarray, v_a: np.ndarray, T_b: np.ndarray, v_b: np.ndarray, d: float, tau: float
):
    """
    Mean and Jacobians at tau: T (4, 4), v (6,), J_pose (6, 24), J_rate (6, 24).

    See `hermite`.
    """
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((6, 24)), np.empty((6, 24))
    hermite(
        T_a, v_a, T_b, v_b, d, tau, T, v, J_pose, J_rate, *lk.workspace(), np.empty((2, 6, 24))
    )
    return T, v, J_pose, J_rate
