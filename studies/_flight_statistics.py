"""
What recorded frames of a VL53L5CX say of the sensor that made them.

The same functions read frames of a real sensor and of a simulated one. Nothing is known of the
place but what the frames say: a zone is compared with the plane through its eight neighbours.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from continuum_loc.measurements import TOF_NO_TARGET, TOF_VALID
from continuum_loc.robot import TofModel
import numpy as np

SIDE = 8
PERIOD_MS = 1000.0 / 15.0
STATUSES = (5, 255, 10, 4, 2, 9, 6, 12, 13)
BANDS = ((0.3, 0.6), (0.6, 1.0), (1.0, 1.5), (2.0, 3.0))  # m
SHORT_MM = 40  # a reading below is short
LEAST_MM = 100  # nearer blocks are left out: what stands there fills no block
# Median of the eight neighbours' residuals, in sigmas of Table I: below the first, a block is so
# flat that its centre tells of noise alone; below the second it is flat; beyond, it has an edge.
SMOOTH, FLAT = 0.5, 1.0
TAIL = 3.0  # sigmas of Table I
_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
_PLANE = np.array([[1.0, j, i] for i, j in _NEIGHBOURS])
_FIT = np.linalg.pinv(_PLANE)
# A centre less the mean of eight neighbours of equal noise scatters by so much more than one zone.
_EXCESS = np.sqrt(1.0 + 1.0 / 8.0)


@dataclass(frozen=True, eq=False)
class Flight:
    """
    Frames of one sensor.

    stamps: (K,) ms. distance: (K, 8, 8) mm, as the driver gives it. status: (K, 8, 8).
    """

    name: str
    stamps: np.ndarray
    distance: np.ndarray
    status: np.ndarray


@dataclass(frozen=True, eq=False)
class Blocks:
    """
    Every 3 x 3 zones with a target in all of them.

    depth: (B,) where the neighbours' plane puts the centre [m]. residual: (B,) of the centre [m].
    roughness: (B,) median of the neighbours' own residuals, in sigmas of Table I.
    """

    depth: np.ndarray
    residual: np.ndarray
    roughness: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(B,) Table I [m]."""
        return TofModel().sigma(self.depth)


def flight_row(flight: Flight) -> dict[str, Any]:
    """Shares [%] by status, of short readings without a target, of frames by how they came."""
    status, distance, stamps = flight.status, flight.distance, flight.stamps
    steps = np.diff(stamps)
    same = (np.diff(distance, axis=0) == 0) & (np.diff(status.astype(int), axis=0) == 0)
    expected = (stamps[-1] - stamps[0]) / PERIOD_MS + 1.0
    return {
        'flight': flight.name,
        'frames': len(stamps),
        **{f'{code}': 100.0 * float(np.mean(status == code)) for code in STATUSES},
        '255 short': 100.0 * float(np.mean(distance[status == TOF_NO_TARGET] < SHORT_MM)),
        'interval [ms]': float(np.median(steps)),
        'one stamp': 100.0 * float(np.mean(steps == 0)),
        'repeated': 100.0 * float(np.mean(same.all(axis=(1, 2)))),
        'lost': max(0.0, 100.0 * (1.0 - len(stamps) / expected)),
    }


def blocks(flights: Iterable[Flight]) -> Blocks:
    """Compare every zone with the plane through its neighbours, over all flights."""
    return _joined([_blocks(flight) for flight in flights])


def _joined(parts: Sequence[Blocks]) -> Blocks:
    names = ('depth', 'residual', 'roughness')
    return Blocks(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _blocks(flight: Flight) -> Blocks:
    depth = 1e-3 * flight.distance
    good = (flight.status == TOF_VALID) & (flight.distance > LEAST_MM)
    inner = slice(1, SIDE - 1)

    def around(grid: np.ndarray) -> np.ndarray:
        return np.stack(
            [
                grid[:, slice(1 + i, SIDE - 1 + i), slice(1 + j, SIDE - 1 + j)]
                for i, j in _NEIGHBOURS
            ],
            axis=-1,
        )

    whole = good[:, inner, inner] & around(good).all(axis=-1)
    centre, neighbours = depth[:, inner, inner][whole], around(depth)[whole]
    # The inverse of a plane's perpendicular depth is linear over a grid of uniform tangents.
    fit = (1.0 / neighbours) @ _FIT.T
    expected = 1.0 / fit[:, 0]
    rough = np.median(np.abs(1.0 / (fit @ _PLANE.T) - neighbours), axis=1)
    seen = (expected > 0.0) & (expected < 4.5)
    expected, centre, rough = expected[seen], centre[seen], rough[seen]
    return Blocks(expected, centre - expected, rough / TofModel().sigma(expected))


def distance_rows(found: Blocks) -> list[dict[str, Any]]:
    """By distance: robust sigma where it is smooth, shares of tails on flats and at edges."""
    rows = []
    flat = found.roughness < FLAT
    beyond = np.abs(found.residual) > TAIL * found.sigma
    for low, high in BANDS:
        here = (found.depth >= low) & (found.depth < high)
        smooth = found.residual[here & (found.roughness < SMOOTH)]
        rows.append(
            {
                'distance [m]': f'{low:g} to {high:g}',
                'blocks': int(here.sum()),
                'Table I [mm]': 1e3 * float(np.median(found.sigma[here]))
                if here.any()
                else np.nan,
                'noise [mm]': 1e3 * robust_sigma(smooth) / _EXCESS,
                'flat [%]': _percent(flat[here]),
                'tails on flats [%]': _percent(beyond[here & flat]),
                'tails at edges [%]': _percent(beyond[here & ~flat]),
                'tails [%]': _percent(beyond[here]),
            }
        )
    return rows


def robust_sigma(values: np.ndarray) -> float:
    """Deviation of a distribution's core: 1.4826 times the median distance from the median."""
    if not len(values):
        return float('nan')
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _percent(flags: np.ndarray) -> float:
    return 100.0 * float(np.mean(flags)) if len(flags) else float('nan')


def spread(rows: Sequence[dict[str, Any]], key: str) -> tuple[float, float, float]:
    """10th, 50th and 90th percentile over flights."""
    return tuple(np.percentile([row[key] for row in rows], [10.0, 50.0, 90.0]).tolist())
