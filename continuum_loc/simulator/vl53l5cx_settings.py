"""How a VL53L5CX departs from an ideal sensor, in numbers."""

from __future__ import annotations

from typing import Literal

from continuum_loc.settings import Settings
import numpy as np
from pydantic import Field, model_validator

# Daylight [klux] that doubles the square of the threshold. Of the datasheet's reach on white, 4 m
# in the dark and 1.4 m at 5 klux: (4 / 1.4)^4 = 1 + 5 / 0.076.
AMBIENT_UNIT = 0.076


class Vl53l5cxSettings(Settings):
    """
    How the sensor departs from ideal.

    Where a number comes from: `flights`, chosen so that `continuum-loc evaluate flights` finds in
    a simulated room what public flights show (first half of their list); `datasheet`, DS13754;
    `publication`, the characterisation by Caroleo, Albini and Maiolino, which reports that there
    is such an effect.
    """

    sub_rays: int = Field(4, ge=1, le=16, description='sub-rays along each side of a zone')
    target_order: Literal['strongest', 'closest'] = 'strongest'
    pulse_width: float = Field(
        0.35,
        gt=0.0,
        description='depth within which returns merge [m] (flights; 0.6 m by the manual)',
    )
    threshold: float = Field(
        0.055, gt=0.0, description='least signal that makes a target in the dark (datasheet)'
    )
    ambient: float = Field(
        0.04, ge=0.0, description='ambient light, as daylight of so many klux (flights)'
    )
    fluctuation: float = Field(
        0.5, ge=0.0, description='relative fading of the signal, 1 sigma (flights)'
    )
    persistence: float = Field(
        0.7, ge=0.0, lt=1.0, description='correlation of the fading from frame to frame (flights)'
    )
    crosstalk: float = Field(
        0.01, ge=0.0, lt=1.0, description="share of a zone's light that reaches each neighbour"
    )
    noise_distance: tuple[float, ...] = Field(
        (0.1, 0.45, 0.8, 1.25, 2.33, 4.0), description='distances of `noise` [m]'
    )
    noise: tuple[float, ...] = Field(
        (0.0015, 0.0016, 0.0032, 0.0050, 0.0085, 0.0160),
        description='core of the noise of a bright target, 1 sigma [m] (flights)',
    )
    faint_noise: float = Field(
        3.0, ge=0.0, description='variance that a target hardly seen has besides (flights)'
    )
    tail: float = Field(
        0.16, ge=0.0, le=1.0, description='share in the tails, of targets hardly seen (flights)'
    )
    tail_size: float = Field(
        5.0, ge=0.0, description='sigma of these, in sigmas of Table I (flights)'
    )
    wide_pulse: float = Field(
        0.076, gt=0.0, description='spread of depth in a zone that earns status 9 [m] (flights)'
    )
    range_offset: float = Field(
        0.008, ge=0.0, description='offset per unit, 1 sigma [m] (datasheet: within 15 mm)'
    )
    range_scale: float = Field(
        0.015, ge=0.0, description='scale per unit, 1 sigma (datasheet: within 5 %; publication)'
    )
    warm_up: float = Field(
        0.004, ge=0.0, description='drift while warming up, 1 sigma over units [m] (publication)'
    )
    warm_up_time: float = Field(
        60.0, gt=0.0, description='time constant of the warming [s] (an assumption)'
    )
    pattern: float = Field(
        0.0013, ge=0.0, description='fixed offsets of zones, 1 sigma [m] (flights)'
    )
    near: float = Field(0.04, ge=0.0, description='a target nearer than this may be none [m]')
    blind: float = Field(
        0.7, ge=0.0, le=1.0, description='share of zones to which such a target is none (flights)'
    )
    dropout: float = Field(
        0.003, ge=0.0, le=1.0, description='probability that a zone misses its target (flights)'
    )
    new_target: float = Field(
        0.75, ge=0.0, le=1.0, description='probability that a target come anew is status 10'
    )
    faint: float = Field(
        0.027, ge=0.0, le=1.0, description='status 4 per zone without a target (flights)'
    )
    stray: float = Field(
        0.008, ge=0.0, le=1.0, description='status 2 begins, per zone without a target (flights)'
    )
    stray_stays: float = Field(
        0.36, ge=0.0, le=1.0, description='probability that status 2 goes on (flights)'
    )
    inconsistent: float = Field(0.0, ge=0.0, le=1.0, description='probability of status 13')

    @model_validator(mode='after')
    def _consistent(self) -> Vl53l5cxSettings:
        if len(self.noise_distance) != len(self.noise) or min(self.noise, default=0.0) <= 0.0:
            raise ValueError(
                'noise_distance and noise must have one value each per row, all greater than 0, '
                f'got {len(self.noise_distance)} and {len(self.noise)}'
            )
        if list(self.noise_distance) != sorted(set(self.noise_distance)):
            raise ValueError(f'noise_distance must increase, got {list(self.noise_distance)}')
        return self

    @property
    def lit_threshold(self) -> float:
        """Least signal that makes a target in the ambient light: it has to beat its shot noise."""
        return self.threshold * float(np.sqrt(1.0 + self.ambient / AMBIENT_UNIT))
