"""The Gaussian process: constant rates, its Jacobians, the bridge, its normal equations."""

from continuum_loc import lie
from continuum_loc.estimator import gp
from continuum_loc.estimator.normal import Normal
import numpy as np
import pytest


def pair(angle: float, seed: int, span: float = 0.1) -> gp.Ends:
    rng = np.random.default_rng(seed)
    xi = 0.3 * rng.normal(size=6)
    xi[3:] *= angle / np.linalg.norm(xi[3:])
    T_a = lie.exp(rng.normal(size=6))
    return gp.Ends(T_a, rng.normal(size=6), T_a @ lie.exp(xi), rng.normal(size=6), span)


def perturbed(ends, x):
    T_a, v_a, T_b, v_b, span = ends
    return gp.Ends(
        T_a @ lie.exp(x[:6]), v_a + x[6:12], T_b @ lie.exp(x[12:18]), v_b + x[18:], span
    )


def central(function, ends, step=1e-6):
    columns = [
        (function(perturbed(ends, step * e)) - function(perturbed(ends, -step * e))) / (2 * step)
        for e in np.eye(24)
    ]
    return np.array(columns).T


def motion(ends):
    e, J = np.empty(12), np.empty((12, 24))
    gp.motion_error(ends, e, J, gp.new_workspace())
    return e, J


def transport(ends):
    e, J = np.empty(6), np.empty((6, 24))
    gp.transport_error(ends, e, J, gp.new_workspace())
    return e, J


@pytest.mark.parametrize('angle', [1e-8, 0.05, 0.6, 2.0, 3.1])
@pytest.mark.parametrize('seed', range(3))
def test_prior_jacobians(angle, seed):
    ends = pair(angle, seed)
    for function in (motion, transport):
        numeric = central(lambda x, f=function: f(x)[0], ends)
        analytic = function(ends)[1]
        np.testing.assert_allclose(analytic, numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize('angle', [1e-8, 0.05, 0.6, 2.0, 3.1])
@pytest.mark.parametrize('fraction', [0.0, 0.2, 0.7, 1.0])
def test_interpolation_jacobians(angle, fraction):
    ends = pair(angle, 5)
    tau = fraction * ends.span
    at = gp.interpolate(ends, tau)

    def pose(x):
        return lie.log(lie.inverse(at.T) @ gp.interpolate(x, tau).T)

    numeric = central(pose, ends)
    np.testing.assert_allclose(at.J_pose, numeric, atol=1e-6 * np.abs(numeric).max())
    numeric = central(lambda x: gp.interpolate(x, tau).v, ends)
    np.testing.assert_allclose(at.J_rate, numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize('first', [0, 3, 4])
def test_what_is_asked_for_alone_is_what_it_is_among_all(first):
    ends = pair(0.8, 7)
    whole, work = gp.interpolate(ends, 0.04), gp.new_workspace()
    gp.relate(ends, work)
    gp.evaluate(work, 0.04, False, first)
    np.testing.assert_array_equal(work['J_rate'][0, first:], whole.J_rate[first:])
    gp.rate_at(work, 0.04)
    np.testing.assert_array_equal(work['v'][0], whole.v)
    gp.pose_at(work, 0.04)
    np.testing.assert_array_equal(work['T'][0], whole.T)


def test_interpolation_is_exact_for_a_constant_rate():
    rate, T_a, d = np.array([1.0, 0.1, -0.2, 0.3, 2.0, -1.5]), lie.exp(np.arange(6) / 5.0), 0.3
    ends = gp.Ends(T_a, rate, T_a @ lie.exp(d * rate), rate, d)
    for tau in np.linspace(0.0, d, 7):
        at = gp.interpolate(ends, tau)
        np.testing.assert_allclose(at.T, T_a @ lie.exp(tau * rate), atol=1e-13)
        np.testing.assert_allclose(at.v, rate, atol=1e-12)
    np.testing.assert_allclose(motion(ends)[0], 0.0, atol=1e-13)


def test_interpolation_hits_both_ends():
    ends = pair(1.0, 9, 0.2)
    for tau, T_end, v_end in ((0.0, ends.T_a, ends.v_a), (0.2, ends.T_b, ends.v_b)):
        at = gp.interpolate(ends, tau)
        np.testing.assert_allclose(at.T, T_end, atol=1e-12)
        np.testing.assert_allclose(at.v, v_end, atol=1e-12)


def test_interpolated_rate_is_the_derivative_of_the_pose():
    ends, step = pair(1.2, 4, 0.2), 1e-6
    for tau in (0.03, 0.11, 0.17):
        ahead, behind = (gp.interpolate(ends, tau + sign * step).T for sign in (1, -1))
        numeric = lie.log(lie.inverse(behind) @ ahead) / (2 * step)
        np.testing.assert_allclose(gp.interpolate(ends, tau).v, numeric, atol=1e-7)


def test_bridge_is_the_conditional_covariance():
    """Against conditioning the joint Gaussian of (x(tau), x(d)) given x(0) directly."""
    d, tau = 0.4, 0.15

    def Q(t):
        return np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])

    Phi = np.array([[1.0, d - tau], [0.0, 1.0]])
    cross = Q(tau) @ Phi.T
    expected = Q(tau) - cross @ np.linalg.solve(Q(d), cross.T)
    np.testing.assert_allclose(gp.bridge(tau, d), expected, atol=1e-15)


def test_normal_equations_equal_the_dense_product():
    ends, q = pair(0.7, 2), np.linspace(1.0, 3.0, 6)
    d, (e, J) = ends.span, motion(ends)
    information = np.linalg.inv(np.kron([[d**3 / 3, d**2 / 2], [d**2 / 2, d]], np.diag(q)))
    normal = Normal.zeros(24)
    squared = gp.add_motion(normal, np.arange(24), e, J, d, 1.0 / q)
    np.testing.assert_allclose(normal.H, np.triu(J.T @ information @ J), rtol=1e-9)
    np.testing.assert_allclose(normal.g, J.T @ information @ e, rtol=1e-9)
    assert squared == pytest.approx(e @ information @ e)
