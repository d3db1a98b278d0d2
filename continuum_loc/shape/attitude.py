"""
Attitude of a module from its IMU, on SO(3) where the paper has Euler angles (eqs. 3-6).

`GravityFilter` integrates the gyro and lets the accelerometer correct tilt alone: the correction
turns about an axis that is level, so yaw is what the gyro makes of the starting value. Gravity
says nothing about yaw; its growing uncertainty is part of the covariance.

Samples are in the IMU's own frame. `map` has z up, and a resting accelerometer reads +g upwards.
"""

from __future__ import annotations

import math

from continuum_loc.compiling import kernel
from continuum_loc.measurements import seconds
from continuum_loc.settings import Settings
import numpy as np
from pydantic import Field

GRAVITY = 9.81  # m/s^2


class AttitudeSettings(Settings):
    """Complementary filter of gyro and accelerometer."""

    time_constant: float = Field(1.0, gt=0.0, description='how slowly gravity corrects tilt [s]')
    gate: float = Field(
        0.4, gt=0.0, description='no correction while |a| departs from g by more [m/s^2]'
    )
    carried: float = Field(
        10.0, ge=1.0, description='how much more slowly while the base is carried'
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
        """Begin at a known rotation, with a gyro bias (3,) [rad/s] and a yaw sigma [rad]."""
        self.R_map_imu = np.array(R_map_imu, dtype=float)
        self.bias = np.array(bias, dtype=float)
        self._start, self.stamp, self._yaw_sigma, self._period = stamp, stamp, yaw_sigma, 0.0
        self.rate = np.zeros(3)

    def update(
        self, stamp: int, gyro: np.ndarray, accel: np.ndarray, moving: bool = False
    ) -> np.ndarray:
        """
        Carry R_map_imu (3, 3) to `stamp` with gyro (3,) [rad/s] and accel (3,) [m/s^2].

        moving: the arm is carried, and accelerates in ways that the gate does not see.
        """
        dt = seconds(stamp, self.stamp)
        slowly = self.settings.carried if moving else 1.0
        gain = 1.0 - math.exp(-dt / (slowly * self.settings.time_constant))
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
        """Standard deviation of the yaw [rad], from the start's, the gyro's walk and its bias."""
        elapsed = seconds(self.stamp, self._start)
        walk = self._gyro_sigma**2 * self._period * elapsed
        return math.sqrt(self._yaw_sigma**2 + walk + (self.settings.bias_sigma * elapsed) ** 2)

    @property
    def tilt_sigma(self) -> float:
        """Standard deviation of either tilt angle [rad] in the steady state."""
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


@kernel
def _turn_and_level(R, rate, accel, dt, gain, gate):
    """
    R <- R exp(rate dt), then turn R towards gravity by `gain` of the tilt error.

    Returns whether gravity was used: not where |accel| is farther from g than the gate.
    """
    _turn(R, rate[0] * dt, rate[1] * dt, rate[2] * dt)
    size = math.sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
    if not abs(size - GRAVITY) <= gate:
        return False
    # Measured x predicted 'up', both in the IMU's frame, is the axis of the turn that brings one
    # onto the other. It is level.
    ax, ay, az = accel[0] / size, accel[1] / size, accel[2] / size
    ux, uy, uz = R[2, 0], R[2, 1], R[2, 2]
    cx, cy, cz = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    if sine > 1e-12:
        scale = gain * math.atan2(sine, ax * ux + ay * uy + az * uz) / sine
        _turn(R, scale * cx, scale * cy, scale * cz)
    return True


@kernel
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
