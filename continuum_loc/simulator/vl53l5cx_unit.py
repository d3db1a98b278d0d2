"""
What one VL53L5CX has of its own, and remembers from frame to frame.

No two units range alike: each has an offset and a scale, settles while it warms up, and its zones
differ by a fixed pattern. A zone's signal fades slowly, so that a faint target comes and goes in
bursts; and its last distance stays in the registers when the target is gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from continuum_loc.simulator.vl53l5cx_settings import Vl53l5cxSettings


@dataclass(eq=False)
class Units:
    """
    S units of Z zones each.

    offset, warm_up: (S, 1) m. scale: (S, 1). pattern: (S, Z) m. blind: (S, Z), zones that call a
    target at their very front none. fading: (S, Z), relative to the signal's noise. seen: (S, Z),
    whether a target was there in the frame before. stray: (S, Z), whether status 2 was. register:
    (S, Z) m, the last distance. frames: (S, 1), frames since power-on.
    """

    offset: np.ndarray
    scale: np.ndarray
    warm_up: np.ndarray
    pattern: np.ndarray
    blind: np.ndarray
    fading: np.ndarray
    seen: np.ndarray
    stray: np.ndarray
    register: np.ndarray
    frames: np.ndarray

    @classmethod
    def drawn(
        cls, count: int, zones: int, settings: Vl53l5cxSettings, rng: np.random.Generator
    ) -> Units:
        """Draw `count` units as they leave the factory, switched on now."""
        unit, zone = rng.standard_normal((3, count, 1)), (count, zones)
        return cls(
            settings.range_offset * unit[0],
            settings.range_scale * unit[1],
            settings.warm_up * unit[2],
            settings.pattern * rng.standard_normal(zone),
            rng.random(zone) < settings.blind,
            rng.standard_normal(zone),
            np.ones(zone, bool),  # a recording begins while the sensor ranges already
            np.zeros(zone, bool),
            np.zeros(zone),
            np.zeros((count, 1), int),
        )

    @classmethod
    def together(cls, units: Sequence[Units]) -> Units:
        """Put units side by side."""
        if len(units) == 1:  # as in a stream of one sensor: nothing to copy
            return units[0]
        return cls(
            *(np.concatenate([getattr(unit, f.name) for unit in units]) for f in fields(cls))
        )

    def apart(self) -> list[Units]:
        """Take them apart again, one unit each."""
        if len(self.offset) == 1:
            return [self]
        return [
            Units(*(getattr(self, f.name)[i:][:1] for f in fields(self)))
            for i in range(len(self.offset))
        ]

    def fade(self, persistence: float, normal: np.ndarray) -> None:
        """Let the fading walk on by one frame; its spread stays 1."""
        self.fading = persistence * self.fading + np.sqrt(1.0 - persistence**2) * normal

    def forget(self, share: float) -> None:
        """Let the registers of zones without a target drift towards 1 m."""
        self.register = np.where(
            self.seen, self.register, self.register + share * (1.0 - self.register)
        )

    def biased(self, depth: np.ndarray, seconds: np.ndarray, warm_up_time: float) -> np.ndarray:
        """Return what the units make of true depths (S, Z) [m], `seconds` (S, 1) after start."""
        drift = self.warm_up * np.exp(-seconds / warm_up_time)
        return (1.0 + self.scale) * depth + self.offset + drift + self.pattern
