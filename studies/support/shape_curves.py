"""
The paper's projected curves (eqs. 11-24), and how curves are compared.

Points and tangents go to the (r, axis) half plane (eq. 12), the curve is fitted there and turned
back by one mean direction (eqs. 23-24). With r >= 0 an S-shape folds over, and bending out of a
plane is lost. `continuum_loc.shape.curves` has the forms in space.
"""

from __future__ import annotations

from continuum_loc.shape.curves import (
    arc_or_line,
    arclength,
    cubic_bezier,
    CurveMethod,
    Fit,
    kasa_circle,
    quadratic_chain,
)
import numpy as np

PARALLEL = 1e-6  # sine of the angle below which two tangents count as parallel


def fit_projected(
    points: np.ndarray, tangents: np.ndarray, method: CurveMethod, samples: int = 61
) -> np.ndarray:
    """Fit (samples, 3) points of the paper's curve through points (N, 3) and tangents (N, 3)."""
    return PROJECTED[method](points, tangents, samples)


def project(vectors: np.ndarray) -> np.ndarray:
    """(N, 2) distance from the axis and position along it, eq. 12."""
    return np.column_stack([np.hypot(vectors[:, 1], vectors[:, 2]), vectors[:, 0]])


def lift(planar: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(C, 3) curve points in space from the half plane (C, 2), eqs. 23-24."""
    total = np.hypot(points[:, 1], points[:, 2]).sum()
    wy, wz = points[:, 1:].sum(axis=0) / total if total > 0.0 else (1.0, 0.0)
    return np.column_stack([planar[:, 1], wy * planar[:, 0], wz * planar[:, 0]])


def projected_quadratic_bezier(
    points: np.ndarray, tangents: np.ndarray, samples: int
) -> np.ndarray:
    """
    Eqs. 11-14: the control point is where neighbouring tangents meet.

    Where they do not meet between the points, the piece is a chord. The printed kappa of eq. 14
    has the opposite sign of the intersection's; here it is mended.
    """
    p, n = project(points), project(tangents)
    chord = np.diff(p, axis=0)
    denominator = cross(n[:-1], n[1:])
    with np.errstate(divide='ignore', invalid='ignore'):
        kappa = cross(chord, n[1:]) / denominator
    length = np.linalg.norm(chord, axis=1)
    meets = (np.abs(denominator) > PARALLEL) & (kappa > 0.0) & (kappa < 2.0 * length)
    control = np.where(
        meets[:, None],
        p[:-1] + np.where(meets, kappa, 0.0)[:, None] * n[:-1],
        p[:-1] + 0.5 * chord,
    )
    return lift(quadratic_chain(p[:-1], control, p[1:], samples), points)


def projected_cubic_bezier(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """Eqs. 15-16."""
    return lift(cubic_bezier(project(points), None, samples), points)


def projected_kasa_arc(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """Eqs. 17-22."""
    planar = project(points)
    return lift(arc_or_line(planar, kasa_circle(planar), samples), points)


def printed_quadratic_bezier(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """Eqs. 12-14 and 23-24 with kappa as printed; not finite where tangents are parallel."""
    p, n = project(points), project(tangents)
    chord = np.diff(p, axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        kappa = cross(n[1:], chord) / cross(n[:-1], n[1:])
        control = p[:-1] + kappa[:, None] * n[:-1]
        return lift(quadratic_chain(p[:-1], control, p[1:], samples), points)


PROJECTED: dict[str, Fit] = {
    'quadratic_bezier': projected_quadratic_bezier,
    'cubic_bezier': projected_cubic_bezier,
    'kasa_arc': projected_kasa_arc,
}


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) z of the cross products of plane vectors (N, 2)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def at_fractions(points: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """(F, 3) points at fractions (F,) of the curve's length."""
    s = arclength(points)
    return np.column_stack(
        [np.interp(np.asarray(fractions) * s[-1], s, column) for column in points.T]
    )
