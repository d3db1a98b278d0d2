"""
SO(3) and SE(3), batch first: every function takes leading batch axes and returns them.

Conventions, which the whole package keeps:
- `T_map_body` maps body coordinates to map coordinates, as (4, 4) homogeneous matrices.
- se(3) vectors are [rho; phi]: translation (m) first, rotation (rad) second.
- Perturbations act on the right: `T <- T @ exp(delta)`, so a covariance is in the body's own
  frame.
- `left_jacobian(xi)` is J with exp(xi + d) = exp(J d) exp(xi); `right_jacobian(xi) =
  left_jacobian(-xi)`.

The SE(3) Jacobians are polynomials in ad(xi) of degree four (its minimal polynomial is A (A^2 +
phi^2)^2): closed forms above an angle of 0.5 rad, Taylor series below, where the closed forms
cancel.
"""

from __future__ import annotations

import numpy as np

SMALL_ANGLE = 0.5

# Taylor coefficients in phi^2 of the polynomials' coefficients, lowest order first.
LEFT_SERIES = np.array(
    [
        [1 / 2, 0, -1 / 720, 1 / 20160, -1 / 1209600, 1 / 119750400, -1 / 17435658240],
        [1 / 6, 0, -1 / 5040, 1 / 181440, -1 / 13305600, 1 / 1556755200, -1 / 261534873600],
        [
            1 / 24,
            -1 / 360,
            1 / 13440,
            -1 / 907200,
            1 / 95800320,
            -1 / 14529715200,
            1 / 2988969984000,
        ],
        [
            1 / 120,
            -1 / 2520,
            1 / 120960,
            -1 / 9979200,
            1 / 1245404160,
            -1 / 217945728000,
            1 / 50812489728000,
        ],
    ]
)
INVERSE_SERIES = np.array(
    [
        [1 / 12, 0, -1 / 30240, -1 / 604800, -1 / 15966720, -691 / 326918592000, -1 / 14944849920],
        [
            -1 / 720,
            -1 / 15120,
            -1 / 403200,
            -1 / 11975040,
            -691 / 261534873600,
            -1 / 12454041600,
            -3617 / 1524374691840000,
        ],
    ]
)


def hat(v: np.ndarray) -> np.ndarray:
    """Skew matrix W (..., 3, 3) of v (..., 3), with W w = v x w (paper eq. 6)."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(phi: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad."""
    phi = np.asarray(phi, float)
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    skew = hat(phi)
    half_sinc = np.sinc(angle / (2.0 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * half_sinc**2 * (skew @ skew)


def so3_log(R: np.ndarray) -> np.ndarray:
    """
    Rotation vectors (..., 3) in rad, angle in [0, pi], of rotation matrices (..., 3, 3).

    Goes through the quaternion whose largest component divides, which is exact near 0 and near pi
    alike.
    """
    R = np.asarray(R, float)
    q = _quaternion(R)
    q = np.where(q[..., :1] < 0.0, -q, q)
    vector_norm = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(vector_norm, q[..., :1])
    small = vector_norm < 1e-12
    return np.where(small, 2.0, angle / np.where(small, 1.0, vector_norm)) * q[..., 1:]


def _quaternion(R: np.ndarray) -> np.ndarray:
    """Convert to unit quaternions (..., 4), w first, by the largest of four equivalent forms."""
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    a, b, c = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    d, e, f = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    forms = np.stack(
        [
            np.stack([1 + xx + yy + zz, a, b, c], -1),
            np.stack([a, 1 + xx - yy - zz, d, e], -1),
            np.stack([b, d, 1 - xx + yy - zz, f], -1),
            np.stack([c, e, f, 1 - xx - yy + zz], -1),
        ],
        -2,
    )
    best = np.argmax(np.diagonal(forms, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(forms, best[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def exp(xi: np.ndarray) -> np.ndarray:
    """Exponential map: transforms (..., 4, 4) of se(3) vectors (..., 6)."""
    xi = np.asarray(xi, float)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = so3_exp(xi[..., 3:])
    T[..., :3, 3] = (_so3_left_jacobian(xi[..., 3:]) @ xi[..., :3, None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log(T: np.ndarray) -> np.ndarray:
    """se(3) vectors (..., 6) of transforms (..., 4, 4); the rotation angle is in [0, pi]."""
    T = np.asarray(T, float)
    phi = so3_log(T[..., :3, :3])
    rho = np.linalg.solve(_so3_left_jacobian(phi), T[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse transforms (..., 4, 4)."""
    out = np.zeros_like(T, dtype=float)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: np.ndarray) -> np.ndarray:
    """Adjoint matrix A (..., 6, 6) of a transform: T exp(xi) T^-1 = exp(A xi)."""
    R = T[..., :3, :3]
    return _block(R, hat(T[..., :3, 3]) @ R)


def ad(xi: np.ndarray) -> np.ndarray:
    """Matrix (..., 6, 6) of the Lie bracket with x: times y it is [x, y]."""
    xi = np.asarray(xi, float)
    return _block(hat(xi[..., 3:]), hat(xi[..., :3]))


def left_jacobian(xi: np.ndarray) -> np.ndarray:
    """(..., 6, 6) left Jacobian of SE(3)."""
    xi = np.asarray(xi, float)
    return _polynomial(
        xi, (np.ones(xi.shape[:-1]), *_left_coefficients(np.linalg.norm(xi[..., 3:], axis=-1)))
    )


def right_jacobian(xi: np.ndarray) -> np.ndarray:
    """J_r (..., 6, 6), right Jacobian of SE(3): exp(xi + d) = exp(xi) exp(J_r d)."""
    return left_jacobian(-np.asarray(xi, float))


def left_jacobian_inverse(xi: np.ndarray) -> np.ndarray:
    """(..., 6, 6) inverse of the left Jacobian; valid for angles below 2 pi."""
    xi = np.asarray(xi, float)
    a, b = _inverse_coefficients(np.linalg.norm(xi[..., 3:], axis=-1))
    one = np.ones(xi.shape[:-1])
    return _polynomial(xi, (one, -0.5 * one, a, 0.0 * one, b))


def right_jacobian_inverse(xi: np.ndarray) -> np.ndarray:
    """(..., 6, 6) inverse of the right Jacobian; valid for angles below 2 pi."""
    return left_jacobian_inverse(-np.asarray(xi, float))


def rotation_error_deg(R_est: np.ndarray, R_true: np.ndarray) -> np.ndarray:
    """Angle (...) in degrees between rotation matrices (..., 3, 3): |Log(R_est^T R_true)|."""
    return np.degrees(np.linalg.norm(so3_log(np.swapaxes(R_est, -1, -2) @ R_true), axis=-1))


def interpolate(T_a: np.ndarray, T_b: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Geodesic T_a exp(fraction log(T_a^-1 T_b)), (..., 4, 4); fraction (...) in [0, 1]."""
    return T_a @ exp(np.asarray(fraction)[..., None] * log(inverse(T_a) @ T_b))


def _so3_left_jacobian(phi: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    skew = hat(phi)
    small = angle < 1e-2
    safe = np.where(small, 1.0, angle)
    third = np.where(
        small, 1 / 6 - angle**2 / 120 + angle**4 / 5040, (safe - np.sin(safe)) / safe**3
    )
    return np.eye(3) + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * skew + third * (skew @ skew)


def _block(diagonal: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """[[diagonal, upper], [0, diagonal]], the form of everything the adjoint generates."""
    out = np.zeros((*diagonal.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = diagonal
    out[..., :3, 3:] = upper
    return out


def _polynomial(xi: np.ndarray, coefficients: tuple[np.ndarray, ...]) -> np.ndarray:
    """Sum of c_i ad(xi)^i, by Horner's rule."""
    A = ad(xi)
    out = coefficients[-1][..., None, None] * np.eye(6)
    for c in coefficients[-2::-1]:
        out = A @ out + c[..., None, None] * np.eye(6)
    return out


def _left_coefficients(angle: np.ndarray) -> list[np.ndarray]:
    """c1..c4 of J_l = I + c1 A + c2 A^2 + c3 A^3 + c4 A^4 (Barfoot, eq. 7.83)."""
    small = angle < SMALL_ANGLE
    f = np.where(small, 1.0, angle)
    s, c = np.sin(f), np.cos(f)
    closed = (
        (4 - f * s - 4 * c) / (2 * f**2),
        (4 * f - 5 * s + f * c) / (2 * f**3),
        (2 - f * s - 2 * c) / (2 * f**4),
        (2 * f - 3 * s + f * c) / (2 * f**5),
    )
    return [
        np.where(small, _series(series, angle), value)
        for series, value in zip(LEFT_SERIES, closed, strict=True)
    ]


def _inverse_coefficients(angle: np.ndarray) -> list[np.ndarray]:
    """
    Compute a, b of J_l^-1 = I - A/2 + a A^2 + b A^4.

    From h(phi) = (phi/2) cot(phi/2) and its derivative at +-i phi.
    """
    small = angle < SMALL_ANGLE
    f = np.where(small, 1.0, angle)
    half = 0.5 * f
    h = half / np.tan(half)
    slope = 0.5 * (h - (half / np.sin(half)) ** 2)  # phi h'(phi) / 2
    closed = ((2 * (1 - h) + slope) / f**2, (slope - h + 1) / f**4)
    return [
        np.where(small, _series(series, angle), value)
        for series, value in zip(INVERSE_SERIES, closed, strict=True)
    ]


def _series(coefficients: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.polynomial.polynomial.polyval(angle * angle, coefficients)
