"""
The true plant: what only the simulator knows of a robot.

Stiffness, mass, friction, tendons, steps.

The estimator never reads these files; see `continuum_loc.robot` for what both sides share.
"""

from __future__ import annotations

from pathlib import Path

from continuum_loc.robot import RobotDescription
from continuum_loc.settings import load_bundled, Settings, SettingsError
import numpy as np
from pydantic import Field, model_validator

PLANTS_FOLDER = Path(__file__).parent / 'plants'


class TendonSet(Settings):
    """Tendons that run parallel to the backbone from the base and end at arclength `end`."""

    end: float = Field(gt=0.0, description='arclength of the disc the tendons are tied to [m]')
    azimuth_deg: tuple[float, ...] = Field(
        min_length=1, description='angle of each about the tangent, from y to z'
    )
    radius: float = Field(gt=0.0, description='distance from the backbone [m]')
    max_force: float = Field(gt=0.0, description='greatest tension [N]')
    friction: float = Field(
        0.0, ge=0.0, description='Coulomb friction of each tendon along its path [N]'
    )


class Profile(Settings):
    """How finely the rod is cut, and the time step."""

    link_length: float = Field(
        gt=0.0, description='target length of a link; rings and module ends cut it [m]'
    )
    time_step: float = Field(gt=0.0, le=0.02, description='[s]')


class PlantSettings(Settings):
    """
    A uniform rod with tendons. Moments are linear in strain: bending EI, twist GJ, stretch EA.

    EA `null` is an inextensible rod; the joint of two links is a ball joint, which has one
    stiffness for all its axes, so GJ must equal EI.
    """

    EI: float = Field(gt=0.0, description='bending stiffness [N m^2]')
    GJ: float = Field(gt=0.0, description='torsional stiffness [N m^2]')
    EA: float | None = Field(None, gt=0.0, description='axial stiffness [N]; null: inextensible')
    mass_per_metre: float = Field(gt=0.0, description='[kg/m]')
    relaxation: float = Field(
        0.05, ge=0.0, description='Kelvin-Voigt: damping moment = relaxation * EI * d kappa/dt [s]'
    )
    contact_friction: float = Field(0.3, ge=0.0, description='sliding friction against the scene')
    carriage_mass: float = Field(
        20.0, gt=0.0, description='reflected inertia of the insertion drive [kg]'
    )
    carriage_stiffness: float = Field(
        1e5, gt=0.0, description='position gain of the insertion drive [N/m]'
    )
    earth_field: tuple[float, float, float] = Field(
        (20e-6, 0.0, -45e-6), description="Earth's field in map [T]"
    )
    tendons: tuple[TendonSet, ...] = ()
    profiles: dict[str, Profile] = Field(min_length=1)

    @model_validator(mode='after')
    def _isotropic(self) -> PlantSettings:
        if not np.isclose(self.EI, self.GJ, rtol=1e-9):
            raise ValueError(
                f'GJ = {self.GJ} must equal EI = {self.EI}: '
                'a ball joint has one stiffness for all axes'
            )
        return self

    def profile(self, name: str) -> Profile:
        """
        Return the profile called `name`.

        Raises SettingsError listing the valid names.
        """
        if name not in self.profiles:
            raise SettingsError(f"no profile '{name}'; profiles: {', '.join(self.profiles)}")
        return self.profiles[name]

    @property
    def tendon_names(self) -> tuple[str, ...]:
        """Names of all tendons, set by set (counted from 1): the order of arrays of tensions."""
        return tuple(
            f'tendon{i + 1}_{k + 1}'
            for i, group in enumerate(self.tendons)
            for k in range(len(group.azimuth_deg))
        )

    @property
    def max_forces(self) -> np.ndarray:
        """(K,) greatest tension of each tendon [N]."""
        return np.array([group.max_force for group in self.tendons for _ in group.azimuth_deg])

    def tension_for_moments(self, moments: np.ndarray, pretension: float = 2.0) -> np.ndarray:
        """
        Tensions (..., K) [N] whose moments add up to the bending moments wanted.

        None is below `pretension`.

        moments: (..., G, 2) total moment about body y and z [N m] inside each tendon set's own
        stretch, base to tip. A set also bends every stretch before its own, so it supplies the
        difference to the next one. Raises ValueError where a tendon would have to pull harder than
        it may.
        """
        wanted = moments - np.concatenate(
            [moments[..., 1:, :], np.zeros_like(moments[..., :1, :])], axis=-2
        )
        tensions = np.concatenate(
            [
                _tensions(group, wanted[..., i, :], pretension)
                for i, group in enumerate(self.tendons)
            ],
            axis=-1,
        )
        excess = (tensions / self.max_forces).reshape(-1, len(self.max_forces)).max(axis=0)
        if excess.max() > 1.0:
            worst = int(np.argmax(excess))
            limit = self.max_forces[worst]
            raise ValueError(
                f'{self.tendon_names[worst]} would have to pull {excess[worst] * limit:.0f} N, '
                f'its limit is {limit:.0f} N: ask for less bending'
            )
        return tensions


def _tensions(group: TendonSet, moment: np.ndarray, pretension: float) -> np.ndarray:
    """
    Least tensions of one set that give `moment` (..., 2).

    What a lone tendon cannot give is left out.

    A tension F at offset r gives the moment r x (-F x): per newton (-r_z, r_y) about (y, z).
    """
    angle = np.radians(group.azimuth_deg)
    arms = group.radius * np.stack([-np.sin(angle), np.cos(angle)])  # (2, k)
    tensions = moment @ np.linalg.pinv(arms).T
    if len(angle) >= 3:
        # Equal tensions of evenly spread tendons cancel, so they can be added freely.
        tensions = tensions - tensions.min(axis=-1, keepdims=True)
    return np.maximum(tensions + pretension, pretension)


def load_plant(name_or_path: str | Path) -> PlantSettings:
    """Load the plant of a bundled robot (by the robot's name), or one from a YAML file."""
    return load_bundled(PlantSettings, PLANTS_FOLDER, name_or_path, 'plant')


def node_arclengths(
    robot: RobotDescription, plant: PlantSettings, link_length: float
) -> np.ndarray:
    """
    (N + 1,) arclengths of the rod's nodes.

    Base, tip, every ring and module end, evenly cut between them.

    A node at every ring makes the ring's pose a body's pose, with no interpolation between the
    two.
    """
    cuts = np.unique(
        np.round([0.0, robot.length, *robot.ring_arclengths, *(g.end for g in plant.tendons)], 9)
    )
    if cuts[-1] > robot.length + 1e-9:
        raise SettingsError(
            f"a tendon set ends at s = {cuts[-1]} m, beyond the robot's length {robot.length} m"
        )
    pieces = [
        np.linspace(a, b, max(1, round((b - a) / link_length)), endpoint=False)
        for a, b in zip(cuts, cuts[1:], strict=False)
    ]
    return np.append(np.concatenate(pieces), cuts[-1])
