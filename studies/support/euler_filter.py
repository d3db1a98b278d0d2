"""The paper's attitude filter in Euler angles (eqs. 3-6), with its printed faults as switches."""

from __future__ import annotations

from dataclasses import dataclass
import math

from continuum_loc.measurements import seconds
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass
class EulerFilter:
    """
    Roll theta, pitch phi and yaw psi of one IMU by the paper's eqs. 3-6 [rad].

    With the defaults the convention is R_map_imu = Rz(psi) Ry(phi) Rx(theta), and a resting
    accelerometer reads g (-sin phi, sin theta cos phi, cos theta cos phi). The printed forms
    depart from it, one switch each:

    pitch_as_printed: eq. 3 has +a_x, the other sign.
    quadrant_as_printed: eq. 3 has arctan(a_y / a_z), which folds beyond 90 degrees.
    swap_as_printed: eq. 6 builds the quaternion with roll and pitch exchanged.
    yaw_as_printed: eq. 5 blends yaw with psi_acc, which is undefined; with 0, real yaw decays to
    nothing.

    The rates of eq. 4 are singular at 90 degrees of pitch in any case.
    """

    alpha: float = 0.2
    pitch_as_printed: bool = False
    quadrant_as_printed: bool = False
    swap_as_printed: bool = False
    yaw_as_printed: bool = False
    angles: np.ndarray | None = None
    stamp: int = 0

    def update(self, stamp: int, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
        """Blend one sample, gyro (3,) [rad/s] and accel (3,) [m/s^2]; returns R_map_imu (3, 3)."""
        roll, pitch = self._from_gravity(accel)
        if self.angles is None:
            self.angles = np.array([roll, pitch, 0.0])
        else:
            carried = self.angles + euler_rates(self.angles, gyro) * seconds(stamp, self.stamp)
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
    """(3,) rates of roll, pitch and yaw [rad/s] from body rates, eq. 4; singular at pitch 90."""
    theta, phi, _ = angles
    sine, cosine, tangent = math.sin(theta), math.cos(theta), math.tan(phi)
    return np.array(
        [
            gyro[0] + sine * tangent * gyro[1] + cosine * tangent * gyro[2],
            cosine * gyro[1] - sine * gyro[2],
            (sine * gyro[1] + cosine * gyro[2]) / math.cos(phi),
        ]
    )
