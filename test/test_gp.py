"""
Gaussian process: exact on constant rates.

Jacobians by finite differences, the bridge by conditioning.
"""

from continuum_loc import lie, lie_kernels
from continuum_loc.estimator import gp
import numpy as np
import pytest


def pair(angle: float, seed: int):
    rng = np.random.default_rng(seed)
    xi = 0.3 * rng.normal(size=6)
    xi[3:] *= angle / np.linalg.norm(xi[3:])
    T_a = lie.exp(rng.normal(size=6))
    return T_a, rng.normal(size=6), T_a @ lie.exp(xi), rng.normal(size=6)


def perturbed(state, x):
    T_a, v_a, T_b, v_b = state
    return T_a @ lie.exp(x[:6]), v_a + x[6:12], T_b @ lie.exp(x[12:18]), v_b + x[18:]


def central(function, state, step=1e-6):
    columns = [
        (function(perturbed(state, step * e)) - function(perturbed(state, -step * e))) / (2 * step)
        for e in np.eye(24)
    ]
    return np.array(columns).T


def motion(state, d=0.1):
    e, J = np.empty(12), np.empty((12, 24))
    gp.motion_error(*state, d, e, J, *lie_kernels.workspace())
    return e, J


def transport(state):
    e, J = np.empty(6), np.empty((6, 24))
    gp.transport_error(*state, e, J, *lie_kernels.workspace())
    return e, J


@pytest.mark.parametrize('angle', [1e-8, 0.05, 0.6, 2.0, 3.1])
@pytest.mark.parametrize('seed', range(3))
def test_prior_jacobians(angle, seed):
    state = pair(angle, seed)
    for function in (motion, transport):
        numeric = central(lambda x, f=function: f(x)[0], state)
        analytic = function(state)[1]
        np.testing.assert_allclose(analytic, numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize('angle', [1e-8, 0.05, 0.6, 2.0, 3.1])
@pytest.mark.parametrize('fraction', [0.0, 0.2, 0.7, 1.0])
def test_interpolation_jacobians(angle, fraction):
    state, d = pair(angle, 5), 0.1
    T, v, J_pose, J_rate = gp.interpolate(*state, d, fraction * d)

    def pose(x):
        return lie.log(lie.inverse(T) @ gp.interpolate(*x, d, fraction * d)[0])

    numeric = central(pose, state)
    np.testing.assert_allclose(J_pose, numeric, atol=1e-6 * np.abs(numeric).max())
    numeric = central(lambda x: gp.interpolate(*x, d, fraction * d)[1], state)
    np.testing.assert_allclose(J_rate, numeric, atol=1e-6 * np.abs(numeric).max())


def test_interpolation_is_exact_for_a_constant_rate():
    rate, T_a, d = np.array([1.0, 0.1, -0.2, 0.3, 2.0, -1.5]), lie.exp(np.arange(6) / 5.0), 0.3
    T_b = T_a @ lie.exp(d * rate)
    for tau in np.linspace(0.0, d, 7):
        T, v, *_ = gp.interpolate(T_a, rate, T_b, rate, d, tau)
        np.testing.assert_allclose(T, T_a @ lie.exp(tau * rate), atol=1e-13)
        np.testing.assert_allclose(v, rate, atol=1e-12)
    np.testing.assert_allclose(motion((T_a, rate, T_b, rate), d)[0], 0.0, atol=1e-13)


def test_interpolation_hits_both_ends():
    T_a, v_a, T_b, v_b = state = pair(1.0, 9)
    for tau, T_end, v_end in ((0.0, T_a, v_a), (0.2, T_b, v_b)):
        T, v, *_ = gp.interpolate(*state, 0.2, tau)
        np.testing.assert_allclose(T, T_end, atol=1e-12)
        np.testing.assert_allclose(v, v_end, atol=1e-12)


def test_interpolated_rate_is_the_derivative_of_the_pose():
    state, step = pair(1.2, 4), 1e-6
    for tau in (0.03, 0.11, 0.17):
        ahead, behind = (gp.interpolate(*state, 0.2, tau + sign * step)[0] for sign in (1, -1))
        numeric = lie.log(lie.inverse(behind) @ ahead) / (2 * step)
        np.testing.assert_allclose(gp.interpolate(*state, 0.2, tau)[1], numeric, atol=1e-7)


def test_bridge_is_the_conditional_covariance():
    """Against conditioning the joint Gaussian of (x(tau), x(d)) given x(0) directly."""
    d, tau, out = 0.4, 0.15, np.empty((2, 2))

    def Q(t):
        return np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])

    Phi = np.array([[1.0, d - tau], [0.0, 1.0]])
    cross = Q(tau) @ Phi.T
    expected = Q(tau) - cross @ np.linalg.solve(Q(d), cross.T)
    gp.bridge(tau, d, out)
    np.testing.assert_allclose(out, expected, atol=1e-15)


def test_normal_equations_equal_the_dense_product():
    state, d = pair(0.7, 2), 0.1
    q = np.linspace(1.0, 3.0, 6)
    e, J = motion(state, d)
    information = np.linalg.inv(np.kron([[d**3 / 3, d**2 / 2], [d**2 / 2, d]], np.diag(q)))
    H, g = np.zeros((24, 24)), np.zeros(24)
    squared = gp.add_motion(H, g, np.arange(24), e, J, d, 1.0 / q)
    np.testing.assert_allclose(H, np.triu(J.T @ information @ J), rtol=1e-9)
    np.testing.assert_allclose(g, J.T @ information @ e, rtol=1e-9)
    assert squared == pytest.approx(e @ information @ e)
