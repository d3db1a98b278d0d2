"""What rays of time-of-flight sensors meet, and what a receiver makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

TOF_TOO_CLOSE = 4  # a consistency failure


@dataclass(frozen=True, eq=False)
class Echoes:
    """
    What K rays of S sensors meet.

    Distance (S, K) along the ray [m], inf where nothing; and the share of light that comes back
    (S, K), reflectance times cosine of incidence.
    """

    distance: np.ndarray
    brightness: np.ndarray


@dataclass(frozen=True, eq=False)
class Readings:
    """
    Per sensor and zone (S, Z), as in `TofFrame`: ranges [m], stated sigma [m], status.

    raw: (S, Z) distance in the driver's registers [m], where the receiver has such; no frame
    carries it.
    """

    ranges: np.ndarray
    sigma: np.ndarray
    status: np.ndarray
    raw: np.ndarray | None = None


class Receiver(Protocol):
    """
    Turns echoes into readings.

    `directions` (K, 3) are the rays that it needs, in the sensor frame.
    """

    directions: np.ndarray

    def read(self, echoes: Echoes, names: Sequence[str], rng: np.random.Generator) -> Readings: ...
