"""Group axioms, the exponential against SciPy's, Jacobians by differences; near 0 and near pi."""

from continuum_loc import lie, lie_kernels
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import expm

ANGLES = (0.0, 1e-9, 1e-4, 0.1, 0.499, 0.501, 1.5, 3.0, np.pi - 1e-6)


def twists(angle: float, count: int = 6, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(count, 6))
    xi[:, 3:] *= angle / np.linalg.norm(xi[:, 3:], axis=1, keepdims=True)
    return xi


def wedge(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = lie.hat(xi[3:]), xi[:3]
    return out


@pytest.mark.parametrize('angle', ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    xi = twists(angle)
    expected = np.array([expm(wedge(x)) for x in xi])
    np.testing.assert_allclose(lie.exp(xi), expected, atol=1e-13)


@pytest.mark.parametrize('angle', ANGLES)
def test_log_inverts_exp(angle):
    xi = twists(angle)
    np.testing.assert_allclose(lie.log(lie.exp(xi)), xi, atol=1e-9)


@pytest.mark.parametrize('angle', ANGLES)
def test_left_jacobian_is_the_derivative_of_exp(angle):
    xi, d = twists(angle), 1e-6 * np.random.default_rng(1).normal(size=(6, 6))
    moved = lie.log(lie.exp(xi + d) @ lie.inverse(lie.exp(xi - d))) / 2.0
    np.testing.assert_allclose((lie.left_jacobian(xi) @ d[..., None])[..., 0], moved, atol=1e-14)
    identity = np.broadcast_to(np.eye(6), (6, 6, 6))
    np.testing.assert_allclose(
        lie.left_jacobian(xi) @ lie.left_jacobian_inverse(xi), identity, atol=1e-12
    )


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=18, max_size=18))
def test_group_axioms(values):
    a, b, c = lie.exp(np.array(values).reshape(3, 6))
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-10)
    np.testing.assert_allclose(a @ lie.inverse(a), np.eye(4), atol=1e-12)
    x = np.array(values[:6]) / 6.0
    np.testing.assert_allclose(
        a @ lie.exp(x) @ lie.inverse(a), lie.exp(lie.adjoint(a) @ x), atol=1e-10
    )


@pytest.mark.parametrize('angle', ANGLES)
def test_kernels_agree_with_the_batch_functions(angle):
    for xi in twists(angle):
        T, back, A = np.empty((4, 4)), np.empty(6), np.empty((6, 6))
        lie_kernels.exp(xi, T)
        lie_kernels.log(T, back)
        np.testing.assert_allclose(T, lie.exp(xi), atol=1e-14)
        np.testing.assert_allclose(back, lie.log(lie.exp(xi)), atol=1e-9)
        lie_kernels.adjoint(T, A)
        np.testing.assert_allclose(A, lie.adjoint(T), atol=1e-14)
        lie_kernels.ad(xi, A)
        c, dc, out, work = np.empty(5), np.empty(5), np.empty((6, 6)), np.empty((2, 6, 6))
        for coefficients, oracle in (
            (lie_kernels.right_coefficients, lie.right_jacobian),
            (lie_kernels.right_inverse_coefficients, lie.right_jacobian_inverse),
        ):
            coefficients(xi, c, dc)
            lie_kernels.polynomial(c, A, out, work)
            np.testing.assert_allclose(out, oracle(xi), atol=1e-12)


@pytest.mark.parametrize('angle', ANGLES)
def test_derivative_of_a_jacobian_times_a_vector(angle):
    w = np.random.default_rng(3).normal(size=6)
    for xi in twists(angle):
        for coefficients, oracle in (
            (lie_kernels.right_coefficients, lie.right_jacobian),
            (lie_kernels.right_inverse_coefficients, lie.right_jacobian_inverse),
        ):
            twist, scratch = np.zeros(1, lie_kernels.TWIST), np.zeros(1, lie_kernels.SCRATCH)
            value, derivative = np.empty(6), np.empty((6, 6))
            twist['x'][0] = xi
            coefficients(xi, twist['c'][0], twist['dc'][0])
            lie_kernels.ad(xi, twist['ad'][0])
            lie_kernels.polynomial_times(twist[0], w, value, derivative, scratch[0])
            step = 1e-5
            numeric = np.array(
                [
                    (oracle(xi + step * e) @ w - oracle(xi - step * e) @ w) / (2 * step)
                    for e in np.eye(6)
                ]
            ).T
            np.testing.assert_allclose(value, oracle(xi) @ w, atol=1e-12)
            np.testing.assert_allclose(derivative, numeric, rtol=1e-6, atol=1e-8)


def test_log_is_exact_at_half_turns():
    for axis in np.eye(3):
        R = lie.so3_exp(np.pi * axis)
        np.testing.assert_allclose(np.abs(lie.so3_log(R)), np.pi * axis, atol=1e-12)


def test_rotation_error_is_the_angle_between():
    R = lie.so3_exp(np.array([0.3, -0.2, 0.1]))
    assert lie.rotation_error_deg(
        R, R @ lie.so3_exp(np.radians([0.0, 2.0, 0.0]))
    ) == pytest.approx(2.0, abs=1e-9)
