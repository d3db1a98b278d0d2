"""
Averages at rest, which refuse motion instead of averaging it in.

Gyro zero-rate offsets reach degrees per second, so the mean rate says nothing about rest. What
does: the spread of the samples against the sensor's noise, and the two halves of the interval,
which have to agree in every channel (a constant turn shows in gravity and in the field).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from continuum_loc.errors import MotionError
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


@dataclass(eq=False)
class RestWindow:
    """
    Collects the samples of one rest.

    Modules are numbered as the robot's `imu` and `hall` sensors.
    """

    robot: RobotDescription
    _rows: dict[tuple[str, str], list[np.ndarray]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, sensors in (
            ('gyro', self.robot.imu),
            ('accel', self.robot.imu),
            ('field', self.robot.hall),
        ):
            self._rows |= {(kind, sensor.name): [] for sensor in sensors}

    def add(self, sample: ImuSample | FieldSample) -> None:
        """Take one sample; sensors that the robot has not are ignored."""
        if isinstance(sample, ImuSample):
            self._append('gyro', sample.sensor, sample.angular_velocity)
            self._append('accel', sample.sensor, sample.linear_acceleration)
        else:
            self._append('field', sample.sensor, sample.field)

    def _append(self, kind: str, name: str, reading: np.ndarray) -> None:
        if (kind, name) in self._rows:
            self._rows[kind, name].append(reading)

    @property
    def fewest(self) -> int:
        """Count the samples of the sensor that sent fewest."""
        return min(len(rows) for rows in self._rows.values())

    def silent(self) -> tuple[str, ...]:
        """Sensors that sent nothing."""
        return tuple(sorted({name for (_, name), rows in self._rows.items() if not rows}))

    def finish(self) -> Rest:
        """
        Take the means.

        Raises MotionError naming every sensor that moved, and ValueError for one that was silent.

        A saturated channel is nan in the mean.
        """
        if self.silent():
            raise ValueError(f'no samples at rest from {", ".join(self.silent())}')
        found = [
            self._motion(kind, name, np.array(rows)) for (kind, name), rows in self._rows.items()
        ]
        if any(found):
            raise MotionError('motion during taring: ' + '; '.join(filter(None, found)))
        means = {
            kind: np.array(
                [np.mean(rows, axis=0) for (k, _), rows in self._rows.items() if k == kind]
            )
            for kind in ('gyro', 'accel', 'field')
        }
        return Rest(**means, samples=self.fewest)

    def _motion(self, kind: str, name: str, rows: np.ndarray) -> str:
        """Tell what moved in one sensor's readings (N, 3), or an empty text."""
        imu, hall = self.robot.imu_model, self.robot.hall_model
        noise, unit, scale = {
            'gyro': (imu.gyro_sigma, 'rad/s', 1.0),
            'accel': (imu.accel_sigma, 'm/s^2', 1.0),
            'field': (np.hypot(hall.sigma, max(hall.lsb) / 12**0.5), 'uT', 1e6),
        }[kind]
        half = len(rows) // 2
        drift = np.abs(rows[:half].mean(axis=0) - rows[-half:].mean(axis=0)).max() if half else 0.0
        spread = rows.std(axis=0).max()
        # The standard deviation of a standard deviation is sigma / sqrt(2 N).
        widest, farthest = (
            noise * (1.0 + GATE / np.sqrt(2.0 * len(rows))),
            GATE * noise * np.sqrt(2.0 / max(half, 1)),
        )
        if spread > widest or drift > farthest:
            return (
                f'{name} {kind} spread {spread * scale:.3g} and drift {drift * scale:.3g} {unit} '
                f'against noise of {noise * scale:.3g}'
            )
        return ''
