"""
Curves through the magnet and the modules: the paper's three (eqs. 11-24), in space.

All take `points` (N, 3) [m] from the magnet on and unit `tangents` (N, 3) there, and give points
(samples, 3) of the curve in the same frame. The paper projects them into a half plane first
(eq. 12), where an S-shape folds over and a bend out of its plane is lost. These forms work on the
points as they are. A straight robot is a line.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from continuum_loc.compiling import kernel
from continuum_loc.errors import InputError
import numpy as np

CurveMethod = Literal['quadratic_bezier', 'cubic_bezier', 'kasa_arc']
STRAIGHT = 1e-5  # sagitta over chord below which an arc is drawn as its line
ARC_TOLERANCE = 1.5e-4  # m rms: points farther from their circle are no single arc


def fit_curve(
    points: np.ndarray,
    tangents: np.ndarray,
    method: CurveMethod = 'kasa_arc',
    samples: int = 61,
) -> np.ndarray:
    """
    Fit (samples, 3) points along the curve of the named method, from first to last point.

    Raises InputError for an unknown method, and for points that the method cannot join.
    """
    if method not in CURVES:
        raise InputError(f"no curve '{method}'; valid: {', '.join(CURVES)}")
    points, tangents = np.asarray(points, float), np.asarray(tangents, float)
    if (
        points.ndim != 2
        or points.shape[1] != 3
        or points.shape != tangents.shape
        or len(points) < 3
    ):
        raise InputError(
            f'expected points and tangents (N >= 3, 3), got {points.shape} and {tangents.shape}'
        )
    return CURVES[method](points, tangents, samples)


def quadratic_bezier(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """
    Two quadratic pieces from each point to the next, which keep both tangents.

    One piece cannot: tangents in space do not meet in general, nor between the points of an
    S-shape. Two always can, with the control polygon of the biarc.
    """
    start, middle, end, first, second = _biarc_polygon(points, tangents)
    return quadratic_chain(
        _interleave(start, middle), _interleave(first, second), _interleave(middle, end), samples
    )


def cubic_bezier(points: np.ndarray, tangents: np.ndarray | None, samples: int) -> np.ndarray:
    """One cubic through four points at t = 0, 1/3, 2/3, 1 (eqs. 15-16 hold in any dimension)."""
    if len(points) != 4:
        raise InputError(f'a cubic Bezier passes through exactly 4 points, got {len(points)}')
    inner = np.array([1.0 / 3.0, 2.0 / 3.0])
    basis = _bernstein(inner)
    controls = np.linalg.solve(basis[:, 1:3], points[1:3] - basis[:, [0, 3]] @ points[[0, 3]])
    return _bernstein(np.linspace(0.0, 1.0, samples)) @ np.vstack([points[0], controls, points[3]])


def kasa_arc(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """
    Kasa's circle in the plane of least squares (SVD), where one arc explains the points.

    Elsewhere it is a chain of biarcs through points and tangents.
    """
    centre = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - centre, full_matrices=False)
    planar = (points - centre) @ axes[:2].T
    fit = kasa_circle(planar)
    radial = size[1:2] if fit is None else np.hypot(*(planar - fit[:2]).T) - fit[2]
    if (radial @ radial + size[2] ** 2) / len(points) > ARC_TOLERANCE**2:
        return biarc_chain(points, tangents, samples)
    return centre + arc_or_line(planar, fit, samples) @ axes[:2]


def biarc_chain(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """Two arcs from each point to the next, tangents continuous throughout."""
    start, middle, end, first, second = _biarc_polygon(points, tangents)
    starts, ends = _interleave(start, middle), _interleave(middle, end)
    headings = _interleave(first - start, second - middle)
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    piece, u = _pieces(len(starts), samples)
    chord = ends - starts
    along = np.einsum('ij,ij->i', chord, headings)
    aside = chord - along[:, None] * headings
    offset = np.linalg.norm(aside, axis=1)
    half_turn = np.arctan2(offset, along)
    curvature = 2.0 * offset / np.einsum('ij,ij->i', chord, chord)
    normal = aside / np.maximum(offset, 1e-300)[:, None]
    turn = 2.0 * half_turn[piece] * u
    length = (
        np.where(curvature > 0.0, 2.0 * half_turn / np.maximum(curvature, 1e-300), along)[piece]
        * u
    )
    forward = length * np.sinc(turn / np.pi)
    sideways = length * np.sin(0.5 * turn) * np.sinc(0.5 * turn / np.pi)
    return starts[piece] + forward[:, None] * headings[piece] + sideways[:, None] * normal[piece]


Fit = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
CURVES: dict[str, Fit] = {
    'quadratic_bezier': quadratic_bezier,
    'cubic_bezier': cubic_bezier,
    'kasa_arc': kasa_arc,
}


# Shared parts


def kasa_circle(planar: np.ndarray) -> np.ndarray | None:
    """
    (3,) centre and radius of the Kasa least-squares circle of (N, 2) points, eqs. 17-20.

    Gives None for points on a line. About the points' mean, eq. 20 falls apart into a 2x2 system
    for the centre and sigma = mean(x^2 + y^2). Raises InputError where all points coincide.
    """
    mean = planar.mean(axis=0)
    q = planar - mean
    S = q.T @ q
    square = (q * q).sum(axis=1)
    determinant = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    spread = S[0, 0] + S[1, 1]
    if spread == 0.0:
        raise InputError('all points of the curve coincide')
    if determinant < 1e-16 * spread**2:
        return None
    half = 0.5 * (q.T @ square)
    centre = (
        np.array([S[1, 1] * half[0] - S[0, 1] * half[1], S[0, 0] * half[1] - S[1, 0] * half[0]])
        / determinant
    )
    radius = np.sqrt(centre @ centre + square.mean())
    if np.sqrt(spread) / (8.0 * radius) < STRAIGHT:
        return None
    return np.array([*(mean + centre), radius])


def arc_or_line(planar: np.ndarray, circle: np.ndarray | None, samples: int) -> np.ndarray:
    """
    Walk (samples, 2) points along the Kasa circle, or along the line where there is none.

    They run from the first point's polar angle to the last one's, eqs. 21-22.
    """
    t = np.linspace(0.0, 1.0, samples)[:, None]
    if circle is None:
        return _line(planar, t)
    angle = np.unwrap(np.arctan2(planar[:, 1] - circle[1], planar[:, 0] - circle[0]))
    sweep = angle[0] + (angle[-1] - angle[0]) * t
    return circle[:2] + circle[2] * np.concatenate([np.cos(sweep), np.sin(sweep)], axis=1)


def _line(planar: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Points at t of the least-squares line between the first and the last point's feet on it."""
    mean = planar.mean(axis=0)
    direction = np.linalg.svd(planar - mean)[2][0]
    foot = (planar[[0, -1]] - mean) @ direction
    return mean + (foot[0] + (foot[1] - foot[0]) * t) * direction


def _biarc_polygon(points: np.ndarray, tangents: np.ndarray) -> tuple[np.ndarray, ...]:
    """
    Start, joint, end and the two inner control points of each biarc, (N - 1, 3) each.

    A biarc joins two neighbours. Both of its arms have the length d for which the middle arm of
    the polygon is 2 d long.
    """
    start, end, t0, t1 = points[:-1], points[1:], tangents[:-1], tangents[1:]
    chord = end - start
    square = np.einsum('ij,ij->i', chord, chord)
    forward = np.einsum('ij,ij->i', chord, t0 + t1)
    spread = 2.0 * (1.0 - np.einsum('ij,ij->i', t0, t1))
    # The positive root of spread d^2 + 2 forward d - square = 0, without cancellation for parallel
    # tangents.
    d = (square / (forward + np.sqrt(forward**2 + spread * square)))[:, None]
    first, second = start + d * t0, end - d * t1
    return start, 0.5 * (first + second), end, first, second


def _interleave(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a, b], axis=1).reshape(-1, a.shape[1])


def _pieces(count: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Which piece each of `samples` even steps lies on, and how far along it (0..1)."""
    position = np.linspace(0.0, count, samples)
    piece = np.minimum(position.astype(int), count - 1)
    return piece, position - piece


def quadratic_chain(
    start: np.ndarray, control: np.ndarray, end: np.ndarray, samples: int
) -> np.ndarray:
    """Chain (samples, D) points along quadratic Bezier pieces, eq. 13."""
    piece, u = _pieces(len(start), samples)
    u = u[:, None]
    return (1 - u) ** 2 * start[piece] + 2 * (1 - u) * u * control[piece] + u**2 * end[piece]


def _bernstein(t: np.ndarray) -> np.ndarray:
    """(T, 4) cubic blending functions."""
    return np.stack([(1 - t) ** 3, 3 * (1 - t) ** 2 * t, 3 * (1 - t) * t**2, t**3], axis=-1)


# What is done with a curve


@kernel
def arclength(points: np.ndarray) -> np.ndarray:
    """(C,) length along the polyline [m]."""
    s = np.zeros(len(points))
    for i in range(1, len(points)):
        s[i] = s[i - 1] + np.sqrt(((points[i] - points[i - 1]) ** 2).sum())
    return s


@kernel
def _cross3(a, b):
    """Compute a x b; NumPy's own takes seconds to compile."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


@kernel
def extended(points: np.ndarray, length: float) -> np.ndarray:
    """Carry a curve that is shorter than `length` [m] on with the curvature of its last tenth."""
    s = arclength(points)
    missing = length - s[-1]
    if missing <= 1e-9:
        return points.copy()
    back = max(2, len(points) // 10)
    a, b, c = points[-1 - 2 * (back // 2)], points[-1 - back // 2], points[-1]
    first, second = b - a, c - b
    bend = _cross3(first, second)
    size = np.sqrt((bend**2).sum())
    chord = np.sqrt((second**2).sum())
    # Two chords of one circle: they turn by the arc between their middles; the tangent is half a
    # chord further on.
    turn = np.arctan2(size, (first * second).sum())
    curvature = 2.0 * np.sin(turn / 2) / chord
    tangent, normal = second / chord, np.zeros(3)
    if size > 1e-30:
        normal = _cross3(bend / size, tangent)
        tangent, normal = (
            np.cos(turn / 2) * tangent + np.sin(turn / 2) * normal,
            np.cos(turn / 2) * normal - np.sin(turn / 2) * tangent,
        )
    count = max(2, int(np.ceil(len(points) * missing / s[-1])))
    out = np.empty((len(points) + count, 3))
    out[: len(points)] = points
    for i in range(count):
        run = missing * (i + 1) / count
        angle = curvature * run
        forward, aside = run, 0.0
        if angle > 1e-9:
            forward, aside = np.sin(angle) / curvature, 2.0 * np.sin(angle / 2) ** 2 / curvature
        out[len(points) + i] = c + forward * tangent + aside * normal
    return out
