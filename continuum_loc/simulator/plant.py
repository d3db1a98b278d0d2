"""
The true plant, which only the simulator knows: stiffness, mass, friction, tendons, steps.

The estimator never reads these files; see `continuum_loc.robot` for what both sides share.
"""

from __future__ import annotations

from pathlib import Path

from continuum_loc.errors import SettingsError
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import load_bundled, Name, Settings
import numpy as np
from pydantic import Field, model_validator

PLANTS_FOLDER = Path(__file__).parent / 'plants'
# Of GJ / EI. The torque that makes the difference is explicit in time: against the implicit spring
# it is stable below 2, with a margin here.
_LEAST_TWIST, _MOST_TWIST = 0.1, 1.8
MOST_LINKS = 1000  # the cost of a step grows with the cube: 150 links are already slow


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

    EA `null` is an inextensible rod. The bundled plants have GJ = EI, the one stiffness of a ball
    joint; another GJ is brought about by a torque beside the joint's spring (`model.advance`).
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
    profiles: dict[Name, Profile] = Field(min_length=1)

    @model_validator(mode='after')
    def _consistent(self) -> PlantSettings:
        if not _LEAST_TWIST * self.EI <= self.GJ <= _MOST_TWIST * self.EI:
            raise ValueError(
                f'GJ = {self.GJ} must lie between {_LEAST_TWIST} and {_MOST_TWIST} times EI = '
                f'{self.EI}; a round solid rod has GJ = EI / (1 + nu), about 0.75 EI'
            )
        ends = [group.end for group in self.tendons]
        if ends != sorted(set(ends)):
            raise ValueError(
                f'tendons: sets must be listed from base to tip, one per end, got ends {ends}'
            )
        return self

    def profile(self, name: str) -> Profile:
        """Return the profile called `name`. Raises SettingsError listing the valid names."""
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
        Tensions (..., K) [N], none below `pretension`, that bend the arm by the moments wanted.

        moments: (..., G, 2) total moment about body y and z [N m] inside each tendon set's own
        stretch, base to tip. A set also bends every stretch before its own, so it supplies the
        difference to the next one. Raises SettingsError where a tendon would have to pull harder
        than it may, or where the plant has other sets than moments are given for.
        """
        if not self.tendons or moments.shape[-2] != len(self.tendons):
            raise SettingsError(
                f'this trajectory bends {moments.shape[-2]} modules, the plant has '
                f'{len(self.tendons)} sets of tendons: give a trajectory (.yaml) for this plant'
            )
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
            raise SettingsError(
                f'{self.tendon_names[worst]} would have to pull {excess[worst] * limit:.0f} N, '
                f'its limit is {limit:.0f} N: ask for less bending, or raise max_force in the '
                'plant'
            )
        return tensions


def _tensions(group: TendonSet, moment: np.ndarray, pretension: float) -> np.ndarray:
    """
    Least tensions of one set that give `moment` (..., 2), as far as lone tendons can.

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


def bundled_plants() -> tuple[str, ...]:
    """Names of the plants that come with the package."""
    return tuple(sorted(file.stem for file in PLANTS_FOLDER.glob('*.yaml')))


def node_arclengths(
    robot: RobotDescription, plant: PlantSettings, link_length: float
) -> np.ndarray:
    """
    (N + 1,) arclengths of the nodes: base, tip, rings and module ends, evenly cut between.

    A node at every ring makes the ring's pose a body's pose, with no interpolation between the
    two.
    """
    _check_fit(robot, plant, link_length)
    cuts = np.unique(
        np.round([0.0, robot.length, *robot.ring_arclengths, *(g.end for g in plant.tendons)], 9)
    )
    pieces = [
        np.linspace(a, b, max(1, round((b - a) / link_length)), endpoint=False)
        for a, b in zip(cuts, cuts[1:], strict=False)
    ]
    return np.append(np.concatenate(pieces), cuts[-1])


def _check_fit(robot: RobotDescription, plant: PlantSettings, link_length: float) -> None:
    """Refuse a plant that cannot be this robot's."""
    for i, group in enumerate(plant.tendons):
        if group.end > robot.length + 1e-9:
            raise SettingsError(
                f'plant: tendons.{i}.end = {group.end} m lies beyond the length '
                f"{robot.length} m of robot '{robot.name}'"
            )
        if group.radius > robot.radius:
            raise SettingsError(
                f'plant: tendons.{i}.radius = {group.radius} m lies outside the body of robot '
                f"'{robot.name}', whose radius is {robot.radius} m"
            )
    links = robot.length / link_length
    if links > MOST_LINKS:
        raise SettingsError(
            f"plant: link_length {link_length} m cuts robot '{robot.name}' into {links:.0f} "
            f'links; at most {MOST_LINKS} are possible: use at least '
            f'{robot.length / MOST_LINKS:g} m'
        )
