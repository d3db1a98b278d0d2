"""
Units, axes and signs of gyros and strain, compared with the body.

A wrong unit or axis leaves the readings a plain function of what the body does. Where one such
function fits them far better than the readings as they are, that is the cause, and it is told in
words. The caller sees to it that the body does not hang on the sensor that is judged.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

DEGREES = 180.0 / np.pi
TRAVEL_SLACK = 0.02  # [m] that an encoder may read beyond the described range
LENGTHS = {'millimetres': 1e-3, 'centimetres': 1e-2}
TOO_NOISY = 100.0  # times the noise described: no motion is that fast
TOO_CURVED = 'curvature 1000 times too large?'
BEYOND = 10.0  # times its reach: no sensor is that far off


def travel_cause(travel: float, limits: tuple[float, float]) -> str:
    """Say that an encoder reads what its base cannot travel [m], or ''."""
    least, most = limits[0] - TRAVEL_SLACK, limits[1] + TRAVEL_SLACK
    if least <= travel <= most:
        return ''
    # In another unit it would lie well within the range, not next to zero.
    likely = {name: 0.05 * most < size * travel <= most for name, size in LENGTHS.items()}
    unit = next((name for name, fits in likely.items() if fits), '')
    said = f'reads {travel:.4g} m, beyond its range of {limits[0]:g} to {limits[1]:g} m'
    return f'{said}: {unit}?' if unit else said


def range_cause(ranges: np.ndarray, max_range: float) -> str:
    """Say that a ToF sensor reads (Z,) [m] what it cannot see, or ''."""
    read = ranges[np.isfinite(ranges)]
    if len(read) < 10 or np.median(read) < BEYOND * max_range:
        return ''
    return f'reads {np.median(read):.4g} m where {max_range:g} m is its reach: millimetres?'


def curvature_cause(kappa: np.ndarray, sigma: float, radius: float) -> str:
    """
    Say that a strain sensor reads what no body does, or ''.

    kappa: (K, M) newest samples at M stations [1/m]; sigma: of a reading [1/m]; radius: of the
    body [m], which cannot bend about a point within itself. Noise far above the one described
    tells the unit while the body is straight.
    """
    if np.median(np.abs(kappa[-1])) * radius > 1.0:
        return TOO_CURVED
    if len(kappa) < 4:
        return ''
    noise = np.median(np.std(np.diff(kappa, axis=0), axis=0)) / 2**0.5
    return TOO_CURVED if noise > TOO_NOISY * sigma else ''


def bending_read(theta: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """Return the bending (K, 2) of angles and curvatures (K,)."""
    return np.column_stack([-kappa * np.sin(theta), kappa * np.cos(theta)])


def _signed_axes() -> list[tuple[str, np.ndarray, int]]:
    """All ways but one to exchange axes and signs, and how many changes each is, fewest first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        moved = sum(place != axis for place, axis in enumerate(order))
        flipped = [axis for axis, sign in zip('xyz', signs, strict=True) if sign < 0.0]
        if moved or flipped:
            M = np.diag(signs) @ np.eye(3)[list(order)]
            found.append((moved + len(flipped), _named(M, moved, flipped), M))
    return [(cause, M, changes) for changes, cause, M in sorted(found, key=lambda one: one[0])]


def _named(M: np.ndarray, moved: int, flipped: list[str]) -> str:
    if not moved:
        return f'sign of axis {" and ".join(flipped)} turned round?'
    body = ', '.join(
        f'{"-" if row[axis] < 0.0 else ""}{"xyz"[axis]}'
        for row in M
        for axis in np.flatnonzero(row)
    )
    return f'axes swapped? ({body}) would fit'


GYRO_CAUSES = [
    ('turns 57 times too fast: degrees per second?', np.eye(3) / DEGREES, 1),
    ('turns 57 times too slowly: converted to radians twice?', np.eye(3) * DEGREES, 1),
    *_signed_axes(),
]
STRAIN_CAUSES = {
    'curvature 1000 times too small: 1/mm?': lambda theta, kappa: (theta, 1e3 * kappa),
    'curvature 100 times too small: 1/cm?': lambda theta, kappa: (theta, 1e2 * kappa),
    TOO_CURVED: lambda theta, kappa: (theta, 1e-3 * kappa),
    'angle in degrees?': lambda theta, kappa: (theta / DEGREES, kappa),
    'angle converted to radians twice?': lambda theta, kappa: (theta * DEGREES, kappa),
    'angle of the other sign?': lambda theta, kappa: (-theta, kappa),
    'curvature of the other sign?': lambda theta, kappa: (theta, -kappa),
    'angle 90 degrees too small?': lambda theta, kappa: (theta + 0.5 * np.pi, kappa),
    'angle 90 degrees too large?': lambda theta, kappa: (theta - 0.5 * np.pi, kappa),
}
