"""
True departures of a world from the descriptions that the estimator reads.

A file of departures has parts (mounts, base, clocks, ...), each with sizes; what they are in one
world is drawn by its seed. Every part draws from a stream of its own, so that one switched on
alone departs as it does among all. `load_departures('disturbed:mounts+base')` takes two parts of
a file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal
import zlib

from continuum_loc.errors import SettingsError
from continuum_loc.robot import based, RobotDescription
from continuum_loc.settings import load_bundled, Settings
from continuum_loc.simulator.departing_sensors import (
    Backlash,
    GyroErrors,
    HallErrors,
    RangeErrors,
    StrainErrors,
)
from continuum_loc.simulator.faults import ClockOffset, Fault, miscalibrated
from continuum_loc.simulator.plant import PlantSettings
from continuum_loc.simulator.vl53l5cx_settings import Vl53l5cxSettings
import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

WORLDS_FOLDER = Path(__file__).parent / 'worlds'
IDEAL = 'ideal'
# A plant whose stiffness departs farther is another robot's.
_MOST_SIGMAS = 2.0


class TofDeparture(Settings):
    """How ToF sensors are simulated."""

    fidelity: Literal['paper', 'vl53l5cx'] = 'vl53l5cx'


class Spread(Settings):
    """Position [m] and rotation [deg] per axis, 1 sigma."""

    position: float = Field(ge=0.0, description='[m]')
    rotation_deg: float = Field(ge=0.0, description='[deg]')


class Displacement(Settings):
    """A shift [m] and a turn [deg] of given size, in directions that are drawn."""

    shift: float = Field(ge=0.0, description='[m]')
    turn_deg: float = Field(ge=0.0, description='[deg]')

    def drawn(self, rng: np.random.Generator) -> np.ndarray:
        """(4, 4): the turn about the origin, then the shift."""
        directions = rng.standard_normal((2, 3))
        shift, turn = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(np.radians(self.turn_deg) * turn).as_matrix()
        T[:3, 3] = self.shift * shift
        return T


class RangeDeparture(Settings):
    """Bias of each ToF unit."""

    offset: float = Field(ge=0.0, description='[m]')
    scale: float = Field(ge=0.0, description='relative')


class Scan(Settings):
    """A prior map that was scanned rather than taken from the drawing."""

    noise: float = Field(0.0, ge=0.0, description='of a point, per axis [m]')
    holes: int = Field(0, ge=0, description='places that the scanner did not see')
    hole_radius: float = Field(0.03, gt=0.0, description='[m]')


class GyroDeparture(Settings):
    """Of each IMU's gyro."""

    scale: float = Field(0.0, ge=0.0, description='per axis, relative')
    axes_deg: float = Field(0.0, ge=0.0, description='of each axis from its place [deg]')
    bias: float = Field(0.0, ge=0.0, description='[rad/s]')
    walk: float = Field(0.0, ge=0.0, description='random walk of the bias [rad/s/sqrt(s)]')


class StrainDeparture(Settings):
    """Of the fibre."""

    scale: float = Field(0.0, ge=0.0, description='relative')
    twist_deg: float = Field(0.0, ge=0.0, description='about the backbone [deg]')
    offset: float = Field(0.0, ge=0.0, description='of each curvature, all along [1/m]')


class HallDeparture(Settings):
    """Of each Hall sensor; the second half grows while it warms up (MLX90393: within 3 %)."""

    scale: float = Field(0.0, ge=0.0, description='per axis, relative')
    axes_deg: float = Field(0.0, ge=0.0, description='of each axis from its place [deg]')
    offset: float = Field(0.0, ge=0.0, description='per axis [T]')
    warm_scale: float = Field(0.0, ge=0.0, description='change of the scale when warm, relative')
    warm_offset: float = Field(0.0, ge=0.0, description='change of the offset when warm [T]')
    warm_time: float = Field(300.0, gt=0.0, description='time constant of the warming [s]')


class ClockDeparture(Settings):
    """Clocks of the boards; a board is all sensors of one ring."""

    offset: float = Field(0.0, ge=0.0, description='of each board, 1 sigma [s]')
    jitter: float = Field(0.0, ge=0.0, description='of every stamp, 1 sigma [s]')
    late_board: float = Field(0.0, ge=0.0, description='by which one board is late [s]')


class StiffnessDeparture(Settings):
    """Of the plant from the one that the drives were planned for."""

    spread: float = Field(ge=0.0, lt=0.5, description='of EI and GJ, relative, within 2 sigma')


class BacklashDeparture(Settings):
    """Of the tendons' drives."""

    play: float = Field(gt=0.0, description='way of a drive that its tendon does not follow [m]')


class Departures(Settings):
    """Everything in which a world departs from what the estimator is told; None is off."""

    tof: TofDeparture | None = None
    mounts: Spread | None = None
    range: RangeDeparture | None = None  # noqa: A003  (a name in files of departures)
    base: Displacement | None = None
    scan: Scan | None = None
    map_frame: Displacement | None = None
    gyro: GyroDeparture | None = None
    strain: StrainDeparture | None = None
    hall: HallDeparture | None = None
    clocks: ClockDeparture | None = None
    stiffness: StiffnessDeparture | None = None
    backlash: BacklashDeparture | None = None
    magnet: Displacement | None = None

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts that are switched on."""
        return tuple(name for name in Departures.model_fields if getattr(self, name) is not None)

    def only(self, *names: str) -> Departures:
        """Leave all parts but some out. Raises SettingsError for a name that is no part of it."""
        for name in names:
            if name not in self.parts:
                raise SettingsError(
                    f"no part '{name}' in this world; parts: {', '.join(self.parts) or 'none'}"
                )
        return Departures(**{name: getattr(self, name) for name in names})

    def fidelity(self, otherwise: str) -> str:
        """ToF fidelity that this world asks for, `otherwise` where it asks for none."""
        return self.tof.fidelity if self.tof else otherwise

    @property
    def map_departs(self) -> bool:
        """Whether the estimator's prior map is another than the scene's own."""
        return self.scan is not None or self.map_frame is not None


def load_departures(name: str | Path) -> Departures:
    """
    Load a world's departures: `ideal`, a bundled name, or a YAML file of one's own.

    Parts of it alone after a colon, joined by `+`. Raises SettingsError.
    """
    name, _, parts = str(name).partition(':')
    if name == IDEAL:
        return Departures()
    whole = load_bundled(Departures, WORLDS_FOLDER, name, 'world')
    return whole.only(*parts.split('+')) if parts else whole


def stream_of(seed: int, part: str) -> np.random.Generator:
    """Return the random stream from which a part draws."""
    return np.random.default_rng([seed, zlib.crc32(part.encode())])


def true_robot(robot: RobotDescription, departures: Departures, seed: int) -> RobotDescription:
    """Mount sensors and base where they truly are."""
    if departures.mounts:
        mounts = departures.mounts
        own_seed = int(stream_of(seed, 'mounts').integers(2**31))
        robot = miscalibrated(robot, mounts.position, mounts.rotation_deg, own_seed)
    if departures.base:
        moved = robot.base.T_map_base @ departures.base.drawn(stream_of(seed, 'base'))
        robot = robot.model_copy(update={'base': based(robot.base, moved)})
    return robot


def true_plant(plant: PlantSettings, departures: Departures, seed: int) -> PlantSettings:
    """Make the plant as stiff as it truly is; GJ keeps its ratio to EI."""
    if not departures.stiffness:
        return plant
    sigmas = np.clip(stream_of(seed, 'stiffness').standard_normal(), -_MOST_SIGMAS, _MOST_SIGMAS)
    factor = 1.0 + departures.stiffness.spread * float(sigmas)
    return plant.model_copy(update={'EI': factor * plant.EI, 'GJ': factor * plant.GJ})


def tof_settings(departures: Departures, fidelity: str) -> Vl53l5cxSettings | None:
    """Return what a VL53L5CX departs by; its ranges are biased by the part `range` alone."""
    if fidelity == 'paper':
        return None
    bias = departures.range or RangeDeparture(offset=0.0, scale=0.0)
    return Vl53l5cxSettings(range_offset=bias.offset, range_scale=bias.scale)


def magnet_error(departures: Departures, seed: int) -> np.ndarray | None:
    """(4, 4) T_magnet_true: where the magnet truly sits in the frame where it should; or None."""
    return departures.magnet.drawn(stream_of(seed, 'magnet')) if departures.magnet else None


def sensor_departures(
    robot: RobotDescription, departures: Departures, fidelity: str, seed: int
) -> tuple[Fault, ...]:
    """Wrappers of the stream of samples, the clocks last."""
    seeds = {part: int(stream_of(seed, part).integers(2**31)) for part in Departures.model_fields}
    found: list[Fault] = []
    if departures.range and robot.tof and fidelity == 'paper':
        perpendicular = robot.tof_model.convention == 'perpendicular'
        cosine = robot.tof_model.directions[:, 0] if perpendicular else 1.0
        sizes = departures.range.model_dump()
        found.append(RangeErrors(**sizes, cosine=cosine, seed=seeds['range']))
    if departures.gyro and robot.imu:
        sizes, limit = departures.gyro.model_dump(), robot.imu_model.gyro_range
        found.append(GyroErrors(**sizes, limit=limit, seed=seeds['gyro']))
    if departures.strain and robot.strain:
        found.append(StrainErrors(**departures.strain.model_dump(), seed=seeds['strain']))
    if departures.hall and robot.hall:
        found.append(HallErrors(**departures.hall.model_dump(), seed=seeds['hall']))
    if departures.backlash:
        found.append(Backlash(play=departures.backlash.play))
    return (*found, *_clocks(robot, departures.clocks, stream_of(seed, 'clocks')))


def _clocks(
    robot: RobotDescription, clocks: ClockDeparture | None, rng: np.random.Generator
) -> tuple[Fault, ...]:
    """One clock for each board, late by its own offset; one of them later still."""
    if clocks is None:
        return ()
    boards = {
        ring: tuple(sensor.name for sensor in robot.sensors if sensor.ring == ring)
        for ring in robot.ring_names
    }
    boards = {ring: names for ring, names in boards.items() if names}
    offsets = clocks.offset * rng.standard_normal(len(boards))
    seeds = rng.integers(2**31, size=len(boards))
    if boards:
        offsets[rng.integers(len(boards))] += clocks.late_board
    return tuple(
        ClockOffset(sensors=names, offset=float(offset), jitter=clocks.jitter, seed=int(one))
        for names, offset, one in zip(boards.values(), offsets, seeds, strict=True)
    )
