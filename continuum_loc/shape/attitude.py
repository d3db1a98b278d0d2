"""
Attitude of a module from its IMU.

`GravityFilter` integrates the gyro on SO(3) and lets the accelerometer correct tilt alone: the
correction turns about an axis that is level, so yaw is what the gyro makes of the starting value.
Gravity says nothing about yaw; its growing uncertainty is part of the covariance.

`EulerFilter` is the paper's form (eqs. 3-6) for comparison, with its printed faults as switches.

Both read samples in the IMU's own frame; `map` has z up, and a resting accelerometer reads +g
upwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math

from continuum_loc.measurements import seconds
from continuum_loc.settings import Settings
from numba import njit
import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

GRAVITY = 9.81  # m/s^2


class AttitudeSettings(Settings):
    """Complementary filter of gyro and accelerometer."""

    time_constant: float = Field(1.0, gt=0.0, description='how slowly gravity corrects tilt [s]')
    gate: float = Field(
        0.4, gt=0.0, description='no correction while |a| departs from g by more [m/s^2]'
    )
    bias_sigma: float = Field(
        1e-4, ge=0.0, description='what the rest average leaves of the gyro bias [rad/s]'
    )


class GravityFilter:
    """Rotation R_map_imu of one IMU, tilt kept by gravity, yaw carried by the gyro."""

    def __init__(self, settings: AttitudeSettings, gyro_sigma: float, accel_sigma: float) -> None:
        self.settings, self._gyro_sigma, self._accel_sigma = settings, gyro_sigma, accel_sigma
        self.R_map_imu: np.ndarray | None = None
        self.gated = 0

    def start(
        self, stamp: int, R_map_imu: np.ndarray, bias: np.ndarray, yaw_sigma: float = 0.0
    ) -> None:
        """
        Begin at a known rotation with a gyro bias (3,) [rad/s].

        Tilt is soon the accelerometer's own.
        """
        self.R_map_imu = np.array(R_map_imu, dtype=float)
        self.bias = np.array(bias, dtype=float)
        self._start, self.stamp, self._yaw_sigma, self._period = stamp, stamp, yaw_sigma, 0.0
        self.rate = np.zeros(3)

    def update(self, stamp: int, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
        """
        Carry the rotation to `stamp` with gyro (3,) [rad/s] and accel (3,) [m/s^2].

        Returns R_map_imu (3, 3).
        """
        dt = seconds(stamp, self.stamp)
        gain = 1.0 - math.exp(-dt / self.settings.time_constant)
        rate = gyro - self.bias
        # The mean of the rates at both ends integrates a smooth motion to second order.
        used = _turn_and_level(
            self.R_map_imu, 0.5 * (rate + self.rate), accel, dt, gain, self.settings.gate
        )
        self.gated += not used
        self.stamp, self.rate, self._period = stamp, rate, dt
        return self.R_map_imu

    def rotation_at(self, stamp: int) -> np.ndarray:
        """R_map_imu carried from the last sample to `stamp` at the last rate."""
        R = self.R_map_imu.copy()
        a, b, c = self.rate * seconds(stamp, self.stamp)
        _turn(R, a, b, c)
        return R

    @property
    def yaw_sigma(self) -> float:
        """
        Compute the standard deviation of the yaw [rad].

        The start's, the gyro's random walk and its bias over time.
        """
        elapsed = seconds(self.stamp, self._start)
        walk = self._gyro_sigma**2 * self._period * elapsed
        return math.sqrt(self._yaw_sigma**2 + walk + (self.settings.bias_sigma * elapsed) ** 2)

    @property
    def tilt_sigma(self) -> float:
        """Compute the standard deviation of either tilt angle [rad] in the steady state."""
        tau = self.settings.time_constant
        gravity = (self._accel_sigma / GRAVITY) ** 2 * self._period / (2.0 * tau)
        gyro = (
            self._gyro_sigma**2 * self._period * tau / 2.0 + (self.settings.bias_sigma * tau) ** 2
        )
        return math.sqrt(gravity + gyro)

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) covariance in map axes [rad^2]: tilt about the level axes, yaw about z."""
        return np.diag([self.tilt_sigma**2, self.tilt_sigma**2, self.yaw_sigma**2])


@njit(cache=True)
def _turn_and_level(R, rate, accel, dt, gain, gate):
    """
    R <- R exp(rate dt), then turn it towards gravity by `gain` of the tilt error.

    False when gated.
    """
    _turn(R, rate[0] * dt, rate[1] * dt, rate[2] * dt)
    size = math.sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
    if not abs(size - GRAVITY) <= gate:
        return False
    # Measured x predicted 'up', both in the IMU's frame: the turn that brings one onto the other,
    # and level.
    ax, ay, az = accel[0] / size, accel[1] / size, accel[2] / size
    ux, uy, uz = R[2, 0], R[2, 1], R[2, 2]
    cx, cy, cz = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    if sine > 1e-12:
        scale = gain * math.atan2(sine, ax * ux + ay * uy + az * uz) / sine
        _turn(R, scale * cx, scale * cy, scale * cz)
    return True


@njit(cache=True)
def _turn(R, a, b, c):
    """R <- R exp([a, b, c]) by the unit quaternion of the turn, in place."""
    half = 0.5 * math.sqrt(a * a + b * b + c * c)
    scale = 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0)
    w, x, y, z = math.cos(half), scale * a, scale * b, scale * c
    for i in range(3):
        p, q, r = R[i, 0], R[i, 1], R[i, 2]
        R[i, 0] = p * (1 - 2 * (y * y + z * z)) + q * 2 * (x * y + z * w) + r * 2 * (x * z - y * w)
        R[i, 1] = p * 2 * (x * y - z * w) + q * (1 - 2 * (x * x + z * z)) + r * 2 * (y * z + x * w)
        R[i, 2] = p * 2 * (x * z + y * w) + q * 2 * (y * z - x * w) + r * (1 - 2 * (x * x + y * y))


def level(R_map_imu: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """R_map_imu (3, 3) turned by the least angle so that the resting `accel` (3,) points up."""
    R = np.array(R_map_imu, dtype=float)
    _turn_and_level(R, np.zeros(3), np.asarray(accel, float), 0.0, 1.0, np.inf)
    return R


@dataclass
class EulerFilter:
    """
    Roll theta, pitch phi and yaw psi of one IMU by the paper's eqs. 3-6 [rad].

    With the defaults the convention is R_map_imu = Rz(psi) Ry(phi) Rx(theta), and a resting
    accelerometer reads g (-sin phi, sin theta cos phi, cos theta cos phi). The printed forms
    depart from it:

    pitch_as_printed: eq. 3 has +a_x, the other sign. quadrant_as_printed: eq. 3 has arctan(a_y /
    a_z), which folds beyond 90 degrees. swap_as_printed: eq. 6 builds the quaternion with roll and
    pitch exchanged.
    yaw_as_printed: eq. 5 blends yaw with psi_acc, which is undefined; 0 makes real yaw decay to
    nothing. The rates of eq. 4 are singular at 90 degrees of pitch in any case.
    """

    alpha: float = 0.2
    pitch_as_printed: bool = False
    quadrant_as_printed: bool = False
    swap_as_printed: bool = False
    yaw_as_printed: bool = False
    angles: np.ndarray | None = None
    stamp: int = 0
    bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # Eqs. 3-6 state no uncertainty. What `ShapeEstimator` reads of a filter is then: always
    # moving, a degree of error, and a yaw that nobody knows.
    rate: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    covariance: np.ndarray = field(default_factory=lambda: np.radians(1.0) ** 2 * np.eye(3))
    yaw_sigma: float = math.inf

    def start(
        self, stamp: int, R_map_imu: np.ndarray, bias: np.ndarray, yaw_sigma: float = 0.0
    ) -> None:
        """
        Begin at a known rotation with a gyro bias (3,) [rad/s].

        Without it: at the first sample with yaw 0.
        """
        self.stamp, self.bias = stamp, np.array(bias, dtype=float)
        self.angles = Rotation.from_matrix(R_map_imu).as_euler('ZYX')[::-1].copy()

    def rotation_at(self, stamp: int) -> np.ndarray:
        """Return the rotation of the last sample."""
        return self.R_map_imu

    def update(self, stamp: int, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
        """Blend one sample, gyro (3,) [rad/s] and accel (3,) [m/s^2]; returns R_map_imu (3, 3)."""
        roll, pitch = self._from_gravity(accel)
        if self.angles is None:
            self.angles = np.array([roll, pitch, 0.0])
        else:
            carried = self.angles + euler_rates(self.angles, gyro - self.bias) * seconds(
                stamp, self.stamp
            )
            measured = np.array([roll, pitch, 0.0 if self.yaw_as_printed else carried[2]])
            # Angles blend along the shorter way round.
            difference = (measured - carried + math.pi) % (2.0 * math.pi) - math.pi
            self.angles = carried + (1.0 - self.alpha) * difference
        self.stamp = stamp
        return self.R_map_imu

    @property
    def R_map_imu(self) -> np.ndarray:
        """(3, 3) rotation of the present angles, eqs. 6-7."""
        theta, phi, psi = self.angles
        about_x, about_y = (phi, theta) if self.swap_as_printed else (theta, phi)
        return Rotation.from_euler('ZYX', [psi, about_y, about_x]).as_matrix()

    def _from_gravity(self, accel: np.ndarray) -> tuple[float, float]:
        """Eq. 3."""
        ax, ay, az = accel
        roll = math.atan(ay / az) if self.quadrant_as_printed else math.atan2(ay, az)
        pitch = math.atan2(ax if self.pitch_as_printed else -ax, math.hypot(ay, az))
        return roll, pitch


def euler_rates(angles: np.ndarray, gyro: np.ndarray) -> np.ndarray:
    """
    (3,) rates of roll, pitch, yaw [rad/s] from body rates, eq. 4.

    They grow without bound at 90 deg of pitch.
    """
    theta, phi, _ = angles
    sine, cosine, tangent = math.sin(theta), math.cos(theta), math.tan(phi)
    return np.array(
        [
            gyro[0] + sine * tangent * gyro[1] + cosine * tangent * gyro[2],
            cosine * gyro[1] - sine * gyro[2],
            (sine * gyro[1] + cosine * gyro[2]) / math.cos(phi),
        ]
    )
