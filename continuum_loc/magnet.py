"""
The field of the ring magnet at the base: the paper's point dipole (eq. 2), and the exact ring.

The shape estimator, the filter's Hall factor and the simulator all take it from here. Both models
take positions [m] relative to the magnet's centre, in the magnet's frame, and give tesla. The
axis is x, as the base's x in the robot files. A negative `remanence` is a magnet mounted upside
down.

The ring is two coaxial current sheets of opposite sign, at the outer and the inner radius. A
sheet's field is Derby and Olbert, "Cylindrical magnets and ideal solenoids" (Am. J. Phys. 78,
2010), in Bulirsch's complete elliptic integral `cel`; its derivative along the axis is the field
of a current loop at either end, and the rest of the gradient follows from div B = 0 and curl B = 0
outside the magnet. So the gradient is exact too.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from continuum_loc.compiling import kernel
from continuum_loc.errors import InputError, SettingsError
from continuum_loc.lie import hat
from continuum_loc.robot import Magnet
import numpy as np

MU_0 = 4e-7 * math.pi
FieldModel = Literal['ring', 'dipole']


class MagnetParameters(NamedTuple):
    """A magnet as the compiled kernels take it."""

    dipole: float  # mu_0 M / 4 pi [T m^3], signed
    sheet: float  # remanence / pi [T], signed
    half_length: float  # [m]; 0 stands for the dipole model
    inner: float  # radius [m]
    outer: float  # radius [m]


def dipole_moment(magnet: Magnet) -> float:
    """Signed moment along the axis [A m^2]: remanence * volume / mu_0 (M_c of eq. 1)."""
    section = math.pi / 4.0 * (magnet.outer_diameter**2 - magnet.inner_diameter**2)
    return magnet.remanence * (section * magnet.length) / MU_0


def magnet_parameters(magnet: Magnet, model: FieldModel = 'ring') -> MagnetParameters:
    """Describe `magnet` to the kernels. Raises SettingsError for a model that does not exist."""
    if model not in ('ring', 'dipole'):
        raise SettingsError(f"field model '{model}' does not exist; valid: ring, dipole")
    return MagnetParameters(
        dipole=1e-7 * dipole_moment(magnet),
        sheet=magnet.remanence / math.pi,
        half_length=magnet.length / 2.0 if model == 'ring' else 0.0,
        inner=magnet.inner_diameter / 2.0,
        outer=magnet.outer_diameter / 2.0,
    )


def ring_field(magnet: Magnet, p: np.ndarray) -> np.ndarray:
    """
    (..., 3) field [T] of the axially magnetised ring at `p` (..., 3) [m], magnet frame (axis x).

    Exact outside the magnet's material (the bore included).
    """
    return field_and_gradient(magnet, p, 'ring')[0]


def field_and_gradient(
    magnet: Magnet, p: np.ndarray, model: FieldModel = 'ring'
) -> tuple[np.ndarray, np.ndarray]:
    """
    Field (..., 3) [T] and gradient dB_i/dp_j (..., 3, 3) [T/m] at `p` (..., 3) [m], magnet frame.

    Raises InputError for positions of another shape, SettingsError for an unknown model.
    """
    p = np.asarray(p, dtype=float)
    if p.shape[-1:] != (3,):
        raise InputError(f'positions must have shape (..., 3), got {p.shape}')
    field, gradient = _field_batch(
        magnet_parameters(magnet, model), np.ascontiguousarray(p.reshape(-1, 3))
    )
    return field.reshape(p.shape), gradient.reshape(*p.shape, 3)


def invert_dipole(magnet: Magnet, field: np.ndarray) -> np.ndarray:
    """
    (..., 3) the one position [m] with x >= 0 whose dipole field is `field` (..., 3) [T].

    The opposite position -p has the same field. In the plane of axis and field, the field's angle
    beta and the position's angle theta off the axis obey tan(beta) = 3 tan(theta) /
    (2 - tan^2(theta)): a quadratic with one root in 0..90 degrees for each beta.
    """
    field = np.asarray(field, dtype=float)
    if field.shape[-1:] != (3,):
        raise InputError(f'fields must have shape (..., 3), got {field.shape}')
    rows = np.ascontiguousarray(field.reshape(-1, 3))
    k = 1e-7 * dipole_moment(magnet)
    return np.array([invert_dipole_once(k, row) for row in rows]).reshape(field.shape)


@kernel
def invert_dipole_once(k, field):
    """Invert the dipole for one field (3,), with k = mu_0 M / 4 pi."""
    sign = 1.0 if k > 0.0 else -1.0
    along, across = sign * field[0], math.hypot(field[1], field[2])
    # The root of across u^2 + 3 along u - 2 across = 0, in the form that does not cancel for
    # either sign.
    root = math.sqrt(9.0 * along**2 + 8.0 * across**2)
    if along >= 0.0:
        theta = math.atan2(4.0 * across, root + 3.0 * along)
    else:
        theta = math.atan2(root - 3.0 * along, 2.0 * across)
    cosine, sine = math.cos(theta), math.sin(theta)
    size = math.sqrt((field**2).sum())
    distance = (abs(k) * math.sqrt(3.0 * cosine**2 + 1.0) / size) ** (1.0 / 3.0)
    cy, cz = (sign * field[1] / across, sign * field[2] / across) if across > 0.0 else (1.0, 0.0)
    return distance * np.array([cosine, sine * cy, sine * cz])


@kernel
def _field_batch(magnet, points):
    field = np.empty_like(points)
    gradient = np.empty((points.shape[0], 3, 3))
    for i in range(points.shape[0]):
        evaluate_field(magnet, points[i], field[i], gradient[i])
    return field, gradient


@kernel
def evaluate_field(magnet, p, field, gradient):
    """Write the field (3,) and its gradient (3, 3) at one point of the magnet's frame."""
    if magnet.half_length == 0.0:
        _dipole(magnet.dipole, p, field, gradient)
    else:
        _ring(magnet, p, field, gradient)


@kernel
def _dipole(k, p, field, gradient):
    """B = k (3 p x - r^2 e_x) / r^5, and its gradient."""
    r2 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    scale = k / (r2 * r2 * math.sqrt(r2))
    x = p[0]
    for i in range(3):
        field[i] = 3.0 * scale * p[i] * x
        for j in range(3):
            gradient[i, j] = -15.0 * scale / r2 * p[i] * p[j] * x
        gradient[i, i] += 3.0 * scale * x
        gradient[i, 0] += 3.0 * scale * p[i]
        gradient[0, i] += 3.0 * scale * p[i]
    field[0] -= scale * r2


@kernel
def _ring(magnet, p, field, gradient):
    """B of the outer current sheet less that of the inner one, and its gradient."""
    strength = magnet.sheet
    rho = math.sqrt(p[1] * p[1] + p[2] * p[2])
    radial, axial, radial_slope, axial_slope = _sheet(magnet.outer, magnet.half_length, rho, p[0])
    if magnet.inner > 0.0:
        r, a, dr, da = _sheet(magnet.inner, magnet.half_length, rho, p[0])
        radial, axial, radial_slope, axial_slope = (
            radial - r,
            axial - a,
            radial_slope - dr,
            axial_slope - da,
        )
    # Near the axis B_rho = -rho/2 dB_x/dx, which is also the limit of B_rho / rho.
    per_rho = radial / rho if rho > 1e-9 else -0.5 * axial_slope
    outward = -axial_slope - per_rho  # div B = 0
    cy, cz = (p[1] / rho, p[2] / rho) if rho > 1e-9 else (1.0, 0.0)
    field[0] = strength * axial
    field[1] = strength * per_rho * p[1]
    field[2] = strength * per_rho * p[2]
    gradient[0, 0] = strength * axial_slope
    gradient[0, 1] = gradient[1, 0] = strength * radial_slope * cy  # curl B = 0
    gradient[0, 2] = gradient[2, 0] = strength * radial_slope * cz
    gradient[1, 1] = strength * (outward * cy * cy + per_rho * cz * cz)
    gradient[2, 2] = strength * (outward * cz * cz + per_rho * cy * cy)
    gradient[1, 2] = gradient[2, 1] = strength * (outward - per_rho) * cy * cz


@kernel
def _sheet(a, half_length, rho, x):
    """B_rho, B_x, dB_rho/dx, dB_x/dx of a unit current sheet (remanence / pi = 1), radius a."""
    gamma = (a - rho) / (a + rho)
    if gamma == 0.0:
        gamma = 1e-15  # the integral's limit at rho = a
    radial = axial = radial_slope = axial_slope = 0.0
    for sign in (1.0, -1.0):
        z = x + sign * half_length
        far2 = z * z + (rho + a) ** 2
        far = math.sqrt(far2)
        kc = math.sqrt((z * z + (a - rho) ** 2) / far2)
        radial += sign * a / far * _cel(kc, 1.0, 1.0, -1.0)
        axial += sign * a / (a + rho) * z / far * _cel(kc, gamma * gamma, 1.0, gamma)
        loop = sign * a / (far2 * far)
        radial_slope += loop * z * _cel(kc, kc * kc, -1.0, 1.0)
        axial_slope += loop * _cel(kc, kc * kc, a + rho, a - rho)
    return radial, axial, radial_slope, axial_slope


@kernel
def _cel(kc, p, c, s):
    """
    Bulirsch's complete elliptic integral, for p > 0 and kc > 0.

    It is the integral of (c cos^2 + s sin^2) / ((cos^2 + p sin^2) sqrt(cos^2 + kc^2 sin^2)) over
    0..pi/2.
    """
    k = kc
    p = math.sqrt(p)
    s = s / p
    f = c
    c = c + s / p
    g = k / p
    s = 2.0 * (s + f * g)
    p = g + p
    g = em = 1.0
    em = k + 1.0
    kk = k
    while abs(g - k) > g * 1e-8:  # convergence is quadratic: the result is good to rounding
        k = 2.0 * math.sqrt(kk)
        kk = k * em
        f = c
        c = c + s / p
        g = kk / p
        s = 2.0 * (s + f * g)
        p = g + p
        g = em
        em = k + em
    return math.pi / 2.0 * (s + c * em) / (em * (em + p))


@kernel
def field_error(magnet, R, p, earth, measured, residual, J):
    """
    Write R^T (B(p) + earth) - measured [T] (3,) and its Jacobian J (3, 6), for one body.

    R, p: its rotation and position in the magnet's frame; J is by a right perturbation [rho; phi].
    This is `field_residual_and_jacobian` for compiled callers.
    """
    source, gradient = np.empty(3), np.empty((3, 3))
    evaluate_field(magnet, p, source, gradient)
    h = np.zeros(3)
    for i in range(3):
        for j in range(3):
            h[i] += R[j, i] * (source[j] + earth[j])
    for i in range(3):
        residual[i] = h[i] - measured[i]
        for j in range(3):
            total = 0.0
            for k in range(3):
                for n in range(3):
                    total += R[k, i] * gradient[k, n] * R[n, j]
            J[i, j] = total
    # d(R^T w) = [h]x phi
    J[0, 3], J[0, 4], J[0, 5] = 0.0, -h[2], h[1]
    J[1, 3], J[1, 4], J[1, 5] = h[2], 0.0, -h[0]
    J[2, 3], J[2, 4], J[2, 5] = -h[1], h[0], 0.0


def field_residual_and_jacobian(
    T_map_body: np.ndarray,
    magnet: Magnet,
    T_map_magnet: np.ndarray,
    measured: np.ndarray,
    earth_field: np.ndarray | tuple = (0.0, 0.0, 0.0),
    model: FieldModel = 'ring',
) -> tuple[np.ndarray, np.ndarray]:
    """
    Residual (..., 3) = R^T (B(p) + earth) - measured [T], and its Jacobian (..., 3, 6).

    The Jacobian is by a right perturbation [rho; phi] of T_map_body (..., 4, 4): it is
    [R^T (dB/dp) R, [h]x], where h is the predicted field in the body's frame.

    T_map_magnet: (4, 4) pose of the magnet's centre, with its axis along x. measured: (..., 3) [T]
    in the body's frame. earth_field: (3,) [T] in map. A saturated axis is nan in `measured` and in
    the residual, and has to be left out.
    """
    R_magnet, R = T_map_magnet[:3, :3], T_map_body[..., :3, :3]
    p_magnet = (T_map_body[..., :3, 3] - T_map_magnet[:3, 3]) @ R_magnet
    source, gradient = field_and_gradient(magnet, p_magnet, model)
    field_map = source @ R_magnet.T + np.asarray(earth_field, float)
    R_t = np.swapaxes(R, -1, -2)
    predicted = (R_t @ field_map[..., None])[..., 0]
    by_position = R_t @ (R_magnet @ gradient @ R_magnet.T) @ R
    return predicted - measured, np.concatenate([by_position, hat(predicted)], axis=-1)
