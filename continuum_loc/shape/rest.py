"""
Averages at rest, which refuse motion instead of averaging it in.

Gyro zero-rate offsets reach degrees per second, so the mean rate says nothing about rest. What
does: the spread of the samples against the sensor's noise, and the two halves of the interval,
which have to agree in every channel (a constant turn shows in gravity and in the field).
"""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc.errors import CalibrationError, MotionError
from continuum_loc.measurements import FieldSample, ImuSample
from continuum_loc.robot import RobotDescription
import numpy as np

GATE = 6.0  # standard deviations; with 9 channels of 3 modules a false alarm in some 1e7 rests


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Mean readings of M modules at rest: gyro, accel, field (M, 3), in the sensors' frames."""

    gyro: np.ndarray
    accel: np.ndarray
    field: np.ndarray
    samples: int


class RestWindow:
    """Collects the samples of one rest, by sensor; sensors that `robot` has not are ignored."""

    def __init__(self, robot: RobotDescription) -> None:
        self._imu, self._hall = robot.imu_model, robot.hall_model
        self._rows: dict[tuple[str, str], list[np.ndarray]] = {
            (kind, sensor.name): []
            for kind, sensors in (('gyro', robot.imu), ('accel', robot.imu), ('field', robot.hall))
            for sensor in sensors
        }

    def add(self, sample: ImuSample | FieldSample) -> None:
        """Take one sample."""
        if isinstance(sample, ImuSample):
            self._append('gyro', sample.sensor, sample.angular_velocity)
            self._append('accel', sample.sensor, sample.linear_acceleration)
        else:
            self._append('field', sample.sensor, sample.field)

    def _append(self, kind: str, name: str, reading: np.ndarray) -> None:
        if (kind, name) in self._rows:
            self._rows[kind, name].append(reading)

    def readings(self, kind: str, name: str) -> np.ndarray:
        """(N, 3) readings of one sensor's `gyro`, `accel` or `field`."""
        return np.array(self._rows[kind, name])

    def finish(self) -> Rest:
        """Take the means, of a robot that rested: what `means` and `check_motion` raise."""
        rest = self.means()
        self.check_motion()
        return rest

    def means(self) -> Rest:
        """
        Average each sensor; a saturated channel is nan in its mean.

        Raises CalibrationError naming the sensors that were silent.
        """
        silent = sorted({name for (_, name), rows in self._rows.items() if not rows})
        if silent:
            raise CalibrationError(f'no samples at rest from {", ".join(silent)}')
        means = {
            kind: np.array(
                [np.mean(rows, axis=0) for (k, _), rows in self._rows.items() if k == kind]
            )
            for kind in ('gyro', 'accel', 'field')
        }
        return Rest(**means, samples=min(len(rows) for rows in self._rows.values()))

    def check_motion(self) -> None:
        """Raise MotionError naming every sensor that moved."""
        found = [text for kind, name in self._rows if (text := self.motion(kind, name))]
        if found:
            raise MotionError('motion during taring: ' + '; '.join(found))

    def motion(self, kind: str, name: str) -> str:
        """Tell what moved in one sensor's readings, or an empty text."""
        noise, unit, scale = {
            'gyro': (self._imu.gyro_sigma, 'rad/s', 1.0),
            'accel': (self._imu.accel_sigma, 'm/s^2', 1.0),
            'field': (np.hypot(self._hall.sigma, max(self._hall.lsb) / 12**0.5), 'uT', 1e6),
        }[kind]
        rows = self.readings(kind, name)
        half = len(rows) // 2
        drift = np.abs(rows[:half].mean(axis=0) - rows[-half:].mean(axis=0)).max() if half else 0.0
        spread = rows.std(axis=0).max()
        # The standard deviation of a standard deviation is sigma / sqrt(2 N).
        widest = noise * (1.0 + GATE / np.sqrt(2.0 * len(rows)))
        farthest = GATE * noise * np.sqrt(2.0 / max(half, 1))
        if spread > widest or drift > farthest:
            return (
                f'{name} {kind} spread {spread * scale:.3g} and drift {drift * scale:.3g} {unit} '
                f'against noise of {noise * scale:.3g}'
            )
        return ''
