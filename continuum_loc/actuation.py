"""
The `actuation` block of a robot description: its tendons, and what they have to bend.

All that is known or identified of a robot's mechanics. What the simulator alone knows of the true
robot stays in its plant files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Literal

from continuum_loc.settings import Name, Settings
import numpy as np
from pydantic import Field, model_validator

Pair = tuple[float, float]


class Tendon(Settings):
    """
    One tendon, beside the backbone from the base to its end; its motor's name in `joint_states`.

    `offset`, `stiffness` and `sign` are for tendons that are displaced.
    """

    name: Name = Field(description="the motor's joint in `joint_states`")
    end: float = Field(gt=0.0, description='arclength of the disc the tendon is tied to [m]')
    azimuth_deg: float = Field(description='angle about the tangent, from body y to z [deg]')
    radius: float = Field(gt=0.0, description='distance from the backbone [m]')
    sign: Literal[1, -1] = Field(1, description='-1 where the motor pulls by going negative')
    offset: float = Field(
        0.0,
        description='wound up at motor position 0 beyond just taut: pretension above 0, slack '
        'below [m]',
    )
    stiffness: float = Field(
        1e4, gt=0.0, description='of tendon and drive, from motor to end [N/m]'
    )


class BodyFriction(Settings):
    """Dry friction in the body, which makes the shape depend on where it came from."""

    share: float = Field(0.0, ge=0.0, description='stiffness until it slides, as share of EI')
    bend: float = Field(1.0, gt=0.0, description='bending that it bears until it slides [1/m]')


class Actuation(Settings):
    """
    Tendons and stiffness.

    A stretch is a part of the body between ends of tendons or modules; `EI` and `rest` have one
    value for all or one per stretch.
    """

    mode: Literal['displacement', 'tension'] = Field(
        'displacement', description="what is known: motors' `position` [m], or their `effort` [N]"
    )
    tendons: tuple[Tendon, ...] = Field(min_length=1)
    EI: tuple[float, ...] = Field(description='bending stiffness [N m^2]', min_length=1)
    GJ: float | None = Field(None, gt=0.0, description='torsion [N m^2]; null: does not twist')
    EA: float | None = Field(None, gt=0.0, description='axial [N]; null: does not stretch')
    rest: tuple[Pair, ...] = Field(
        ((0.0, 0.0),), min_length=1, description='bending about y and z without load [1/m]'
    )
    friction: BodyFriction = BodyFriction()
    weight: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description='weight of the body in `map` [N/m]'
    )
    delay: float = Field(
        0.0, description='how much later than its stamp a joint state shows in the body [s]'
    )
    strain_sigma: tuple[float, float, float] = Field(
        (0.01, 0.3, 0.3),
        description='how far stretch, bending y and z depart from the statics, 1 sigma [1, 1/m]',
    )

    @model_validator(mode='after')
    def _consistent(self) -> Actuation:
        if min(self.EI) <= 0.0 or min(self.strain_sigma) <= 0.0:
            raise ValueError('EI and strain_sigma must be greater than 0')
        counts = Counter(tendon.name for tendon in self.tendons)
        if doubled := sorted(name for name, count in counts.items() if count > 1):
            raise ValueError(f'tendons: names used more than once: {", ".join(doubled)}')
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Motors, in the order of the tendons."""
        return tuple(tendon.name for tendon in self.tendons)

    def stretches(self, length: float, module_ends: Sequence[float]) -> np.ndarray:
        """Arclengths (G,) at which stretches end, of a body of that length and module ends [m]."""
        ends = [tendon.end for tendon in self.tendons]
        return np.unique(np.round([*ends, *module_ends, length], 9))

    def check(self, length: float, radius: float, module_ends: Sequence[float]) -> None:
        """Raise ValueError for tendons or stretches that are none of such a body's."""
        for tendon in self.tendons:
            if tendon.end > length + 1e-9:
                raise ValueError(
                    f"actuation: tendon '{tendon.name}' ends at {tendon.end} m, beyond the length "
                    f'of {length} m'
                )
            if tendon.radius > radius + 1e-9:
                raise ValueError(
                    f"actuation: tendon '{tendon.name}' runs {tendon.radius} m from the backbone, "
                    f'outside the body of radius {radius} m'
                )
        ends = self.stretches(length, module_ends)
        for what, values in (('EI', self.EI), ('rest', self.rest)):
            if len(values) not in (1, len(ends)):
                raise ValueError(
                    f'actuation: {what} has {len(values)} values; valid: one, or {len(ends)}, for '
                    f'stretches that end at {", ".join(f"{s:g}" for s in ends)} m'
                )
