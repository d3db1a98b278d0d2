"""
What carries the base: a scripted motion, and what is told of it.

The carrier is an arm, a carriage or a vehicle of six drives that follow keyframes. What it tells
of where it is departs from the truth: by an error of its kinematics that lasts, by white noise,
by a clock, and, where it is odometry, by a drift that grows with its way.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from continuum_loc import lie
from continuum_loc.errors import SettingsError
from continuum_loc.measurements import BaseSample
from continuum_loc.robot import RobotDescription, Vector3
from continuum_loc.settings import load_settings, Settings
import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

JOINTS = ('carry_x', 'carry_y', 'carry_z', 'carry_yaw', 'carry_pitch', 'carry_roll')
PACE = 2.0  # [s] after which odometry is wrong in another way
STEADY = 2e-5  # [m/sqrt(s), rad/sqrt(s)] walk of odometry


class CarrierKeyframe(Settings):
    """Where the base is carried to by one time."""

    time: float = Field(ge=0.0, description='seconds from the start')
    xyz: Vector3 = Field((0.0, 0.0, 0.0), description="from the description's base, along it [m]")
    rpy_deg: Vector3 = Field((0.0, 0.0, 0.0), description='roll, pitch, yaw from there [deg]')


class Told(Settings):
    """How what a carrier tells of its base departs from the truth."""

    error_position: float = Field(0.001, ge=0.0, description='lasting error, 1 sigma [m]')
    error_rotation_deg: float = Field(0.2, ge=0.0, description='lasting error, 1 sigma [deg]')
    lasting: float = Field(5.0, gt=0.0, description='how long it lasts [s]')
    noise_position: float = Field(0.0002, ge=0.0, description='white noise of a sample [m]')
    noise_rotation_deg: float = Field(0.02, ge=0.0, description='white noise of a sample [deg]')
    latency: float = Field(0.0, ge=0.0, description='by how much the stamps are late [s]')
    drift: float = Field(
        0.0, ge=0.0, description='odometry: error as a share of the way and of the turn, 1 sigma'
    )


class CarrierFile(Settings):
    """A carrier of your own, as YAML."""

    keyframes: tuple[CarrierKeyframe, ...] = Field(min_length=2)
    told: Told = Told()

    @model_validator(mode='after')
    def _in_order(self) -> CarrierFile:
        times = [frame.time for frame in self.keyframes]
        if any(b <= a for a, b in zip(times, times[1:], strict=False)):
            raise ValueError(f'keyframes: times must increase, got {times}')
        return self


@dataclass(frozen=True, eq=False)
class Carrier:
    """
    Keyframes: times (M,) s; values (M, 6), x y z [m] and yaw pitch roll [rad] of JOINTS.

    They are held before the first and after the last.
    """

    name: str
    times: np.ndarray
    values: np.ndarray
    told: Told = Told()
    _spline: PchipInterpolator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        times = np.concatenate([[self.times[0] - 1.0], self.times, [self.times[-1] + 1.0]])
        rows = self.values[[0, *range(len(self.values)), -1]]
        object.__setattr__(self, '_spline', PchipInterpolator(times, rows))

    def command(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return value and rate (6,) of each drive at `time` [s]."""
        at = min(max(time, self.times[0]), self.times[-1])
        return self._spline(at), self._spline(at, 1)

    def roll(self, time: float) -> float:
        """Return the turn about the base's own x at `time` [s], in radians."""
        return float(self.command(time)[0][5])


# Keyframes: time [s], x, y, z [m], roll, pitch, yaw [deg] from where the description has the base.
# In the engine the way leads along its gap: half a metre in and out, and 30 deg about it.
_ENGINE = {
    'still': [(0.0, 0, 0, 0, 0, 0, 0), (20.0, 0, 0, 0, 0, 0, 0)],
    'smooth': [
        (1.0, 0, 0, 0, 0, 0, 0),
        (4.0, -0.35, 0.01, 0.005, 15, 0.5, -0.5),
        (7.0, -0.1, -0.01, 0.005, -10, -0.5, 0.5),
        (10.0, 0.12, 0.005, -0.005, 15, 0.3, 0.3),
        (13.5, -0.3, 0.0, 0.01, -15, 0.5, 0.5),
        (17.0, -0.1, -0.01, 0.0, 10, -0.5, 0.0),
        (20.0, -0.1, -0.01, 0.0, 10, -0.5, 0.0),
    ],
    'brisk': [
        (1.0, 0, 0, 0, 0, 0, 0),
        (2.2, -0.25, 0.01, 0.005, 15, 0.5, -0.5),
        (3.4, 0.0, -0.01, 0.005, -12, -0.5, 0.5),
        (4.6, -0.38, 0.005, -0.005, 15, 0.3, 0.3),
        (5.8, -0.05, 0.005, 0.005, -15, 0.5, -0.5),
        (7.0, 0.12, 0.0, 0.0, 10, 0.0, 0.5),
        (8.2, -0.3, -0.01, 0.005, -10, 0.0, 0.0),
        (9.4, 0.0, 0.0, 0.0, 15, 0.0, 0.0),
        (20.0, 0.0, 0.0, 0.0, 15, 0.0, 0.0),
    ],
    'stops': [
        (1.0, 0, 0, 0, 0, 0, 0),
        (2.5, -0.3, 0.01, 0.005, 12, 0.5, -0.5),
        (3.5, -0.3, 0.01, 0.005, 12, 0.5, -0.5),
        (5.5, 0.0, -0.01, 0.005, -15, -0.5, 0.5),
        (6.5, 0.0, -0.01, 0.005, -15, -0.5, 0.5),
        (8.0, -0.38, 0.0, 0.0, 15, 0.3, 0.0),
        (9.5, -0.38, 0.0, 0.0, 15, 0.3, 0.0),
        (11.5, 0.12, 0.005, 0.0, -6, 0.0, 0.0),
        (20.0, 0.12, 0.005, 0.0, -6, 0.0, 0.0),
    ],
}
# The Hall arm on a wrist: 0.3 m and 60 deg, turning at up to 60 deg/s.
_HALL = {
    'still': _ENGINE['still'],
    'wrist': [
        (3.0, 0, 0, 0, 0, 0, 0),
        (5.0, 0.10, 0.20, 0.0, 20, 50, 0),
        (7.0, 0.0, 0.30, -0.05, 50, 0, 40),
        (9.0, -0.10, 0.10, 0.05, 0, -45, 30),
        (10.6, 0.0, 0.0, 0.0, -20, 0, -20),
        (12.2, 0.05, 0.2, 0.1, 25, 35, 10),
        (14.0, 0.0, 0.0, 0.0, 0, 0, 0),
        (20.0, 0.0, 0.0, 0.0, 0, 0, 0),
    ],
}
CARRIERS = {'engine': _ENGINE, 'hall_arm': _HALL}


def carrier(name: str, robot: RobotDescription, told: Told | None = None) -> Carrier:
    """Find the named carrier of this robot, or load one from a YAML file (`CarrierFile`)."""
    if name.endswith(('.yaml', '.yml')):
        read = load_settings(CarrierFile, name)
        rows = [(one.time, *one.xyz, *one.rpy_deg) for one in read.keyframes]
        return _carrier(name, rows, told or read.told)
    tables = CARRIERS.get(robot.name, {})
    if name not in tables:
        raise SettingsError(
            f"nothing called '{name}' carries robot '{robot.name}'; give a .yaml file of your own"
            + (f', or one of {", ".join(tables)}' if tables else '')
        )
    return _carrier(name, tables[name], told or Told())


def _carrier(name: str, rows: list[tuple[float, ...]], told: Told) -> Carrier:
    values = np.array(rows, float)
    turns = np.radians(values[:, [6, 5, 4]])  # the drives are yaw, pitch and roll
    return Carrier(name, values[:, 0], np.hstack([values[:, 1:4], turns]), told)


def pose_of(values: np.ndarray) -> np.ndarray:
    """(..., 4, 4) pose of the base, from where the description has it, of drives (..., 6)."""
    T = np.tile(np.eye(4), (*values.shape[:-1], 1, 1))
    flat = values[..., 3:].reshape(-1, 3)
    R = Rotation.from_euler('ZYX', flat).as_matrix()
    T[..., :3, :3] = R.reshape(*values.shape[:-1], 3, 3)
    T[..., :3, 3] = values[..., :3]
    return T


class BaseTeller:
    """What the carrier tells of its base, sample by sample."""

    def __init__(self, told: Told, frame: str, rate: float, rng: np.random.Generator) -> None:
        self.told, self.frame, self.rate, self._rng = told, frame, rate, rng
        turn, noise = np.radians([told.error_rotation_deg, told.noise_rotation_deg])
        self._sigma = np.repeat([told.error_position, turn], 3)
        self._noise = np.repeat([told.noise_position, noise], 3)
        self._lasting = self._sigma * rng.standard_normal(6)
        self._scale = told.drift * rng.standard_normal(6)
        self._T_frame_base: np.ndarray | None = None
        self._T_map_base: np.ndarray | None = None
        self._past: deque[tuple[float, np.ndarray]] = deque(maxlen=3 + round(told.latency * rate))

    def measure(self, stamp: int, time: float, T_map_base: np.ndarray) -> list[BaseSample]:
        """Tell, at `time` [s], of the pose (4, 4) of `latency` ago; T_map_base is the present."""
        self._past.append((time, self._wrong(T_map_base)))
        T = self._at(time - self.told.latency)
        T = T @ lie.exp(self._noise * self._rng.standard_normal(6))
        covariance = np.diag(np.square(np.maximum(self._noise, 1e-6)))
        return [BaseSample(stamp, self.frame, T, covariance)]

    def _wrong(self, T_map_base: np.ndarray) -> np.ndarray:
        """Return the base as kinematics, or odometry, have it."""
        if self.told.drift > 0.0:
            return self._reckoned(T_map_base)
        self._lasting = self._walked(self._lasting, self._sigma, self.told.lasting)
        return T_map_base @ lie.exp(self._lasting)

    def _reckoned(self, T_map_base: np.ndarray) -> np.ndarray:
        """Add up steps that are all a little too long or too short, from where it began."""
        if self._T_map_base is None:
            self._T_map_base, self._T_frame_base = T_map_base, np.eye(4)
            return self._T_frame_base
        step = lie.log(lie.inverse(self._T_map_base) @ T_map_base)
        walk = STEADY / np.sqrt(self.rate) * self._rng.standard_normal(6)
        self._scale = self._walked(self._scale, np.full(6, self.told.drift), PACE)
        moved = lie.exp((1.0 + self._scale) * step + walk)
        self._T_map_base, self._T_frame_base = T_map_base, self._T_frame_base @ moved
        return self._T_frame_base

    def _walked(self, value: np.ndarray, sigma: np.ndarray, lasting: float) -> np.ndarray:
        """Let a value wander on for one sample, and keep its spread."""
        kept = np.exp(-1.0 / (self.rate * lasting))
        return kept * value + np.sqrt(1.0 - kept**2) * sigma * self._rng.standard_normal(6)

    def _at(self, time: float) -> np.ndarray:
        times = np.array([one[0] for one in self._past])
        after = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
        if len(times) == 1 or time <= times[0]:
            return self._past[0][1]
        a, b = self._past[after - 1], self._past[after]
        share = np.array((time - a[0]) / (b[0] - a[0]))
        return lie.interpolate(a[1], b[1], share)
