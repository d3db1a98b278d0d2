"""One module between its samples and the estimate: its attitude, and the field at its place."""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc.measurements import FieldSample, ImuSample
from continuum_loc.plausible import Turns
from continuum_loc.robot import RobotDescription
from continuum_loc.shape.attitude import GravityFilter, level
from continuum_loc.shape.base_motion import BaseMotion
from continuum_loc.shape.calibration import ModuleMounts
from continuum_loc.shape.rest import Rest
from continuum_loc.shape.settings import ShapeSettings
import numpy as np

RESUMED_YAW = np.radians(3.0)  # rad, 1 sigma


@dataclass(eq=False)
class Stream:
    """One sensor's last reading, and what its readings look like."""

    full_scale: np.ndarray
    stamp: int | None = None
    reading: np.ndarray | None = None
    repeats: int = 0
    saturated: bool = False

    def take(self, stamp: int, reading: np.ndarray) -> bool:
        """Note a reading. False when it is no newer than the last."""
        if self.stamp is not None and stamp <= self.stamp:
            return False
        # nan equals nan.
        same = self.reading is not None and reading.tobytes() == self.reading.tobytes()
        self.repeats = self.repeats + 1 if same else 1
        # Also where an axis is nan.
        self.saturated = not (np.abs(reading) < self.full_scale).all()
        self.stamp, self.reading = stamp, reading
        return True


class Module:
    """
    One module's streams, attitude and field.

    `place` counts the modules from the base. `use` gives it its calibration, `start` its state
    after a rest; before both it only notes readings.
    """

    def __init__(
        self, place: int, robot: RobotDescription, settings: ShapeSettings, base: BaseMotion
    ) -> None:
        imu, hall = robot.imu_model, robot.hall_model
        self.place, self.name = place, robot.hall[place].ring
        self.attitude = GravityFilter(settings.attitude, imu.gyro_sigma, imu.accel_sigma)
        self.imu = Stream(np.repeat([imu.gyro_range, imu.accel_range], 3))
        self.hall = Stream(np.asarray(hall.saturation) + 0.5 * np.asarray(hall.lsb))
        self.turns = Turns()
        # The total field in the base frame [T], averaged while the module rests.
        self.field_base: np.ndarray | None = None
        self.averaged = 0
        # The IMU was silent or frozen: its attitude is stale until it starts again.
        self.lost = False
        self._base = base
        self._still = settings.still
        self._gain = min(1.0, 1.0 / (hall.rate * max(settings.smoothing, 1e-9)))

    def use(self, mounts: ModuleMounts) -> None:
        """Set what a calibration says of the mounts and offsets of all modules."""
        m = self.place
        self.R_module_imu, self.accel_offset = mounts.R_module_imu[m], mounts.accel_offset[m]
        self.R_module_hall, self.hall_offset = mounts.R_module_hall[m], mounts.hall_offset[m]

    def start(self, stamp: int, rest: Rest, yaw_sigma: float) -> None:
        """Begin at the rotation of the straight robot, levelled to the gravity of a rest."""
        m = self.place
        self.rest_accel, self.rest_field = rest.accel[m] - self.accel_offset, rest.field[m]
        self._R_map_rest = self._base.rotation(stamp)
        R_map_imu = self._levelled(self.rest_accel)
        self.attitude.start(stamp, R_map_imu, rest.gyro[m], yaw_sigma)
        if np.isfinite(rest.field[m]).all():
            R_base_hall = self.R_base_module(stamp) @ self.R_module_hall
            self.field_base = R_base_hall @ (rest.field[m] - self.hall_offset)
            self.averaged = rest.samples

    def _levelled(self, accel: np.ndarray) -> np.ndarray:
        """R_map_imu at the straight robot, turned by the least angle so that `accel` points up."""
        return level(self._R_map_rest @ self.R_module_imu, accel)

    def turn(self, sample: ImuSample, R_base_module: np.ndarray) -> None:
        """Carry the attitude on. An IMU that was lost starts again at the backbone's rotation."""
        accel = sample.linear_acceleration - self.accel_offset
        if self.lost:
            if self.imu.repeats > 1:
                return
            self.lost = False
            R_map_base = self._base.rotation(sample.stamp)
            R_map_imu = level(R_map_base @ R_base_module @ self.R_module_imu, accel)
            self.attitude.start(sample.stamp, R_map_imu, self.attitude.bias, RESUMED_YAW)
            self.turns.clear()
        moving = self._base.moves(sample.stamp)
        self.attitude.update(sample.stamp, sample.angular_velocity, accel, moving)
        self.turns.add(sample.stamp, self.attitude.rate, accel)

    def sense(self, sample: FieldSample) -> None:
        """Smooth the field in the base frame, where it stands still as long as the module does."""
        R_base_hall = self.R_base_module(sample.stamp) @ self.R_module_hall
        field_base = R_base_hall @ (sample.field - self.hall_offset)
        rate = self.attitude.rate
        if self.averaged == 0 or rate @ rate > self._still**2:
            self.field_base, self.averaged = field_base, 1
        else:
            # The mean of what came since the module rests, then a mean that forgets.
            self.averaged += 1
            gain = max(1.0 / self.averaged, self._gain)
            self.field_base = self.field_base + gain * (field_base - self.field_base)

    def R_base_module(self, stamp: int) -> np.ndarray:
        """(3, 3) rotation at `stamp`, a little after the last sample."""
        R_map_imu = self.attitude.rotation_at(stamp)
        return self._base.rotation(stamp).T @ R_map_imu @ self.R_module_imu.T

    def R_base_module_if(self, stamp: int, axes: np.ndarray) -> np.ndarray:
        """
        (3, 3) rotation at `stamp` if `axes` @ what the IMU reads had been read from the start.

        axes: a rotation (3, 3). Turned readings w' = axes^T w integrate to R0' axes^T exp(w) axes,
        from the start R0' that they were levelled to, so that both starts tell the difference.
        """
        begun = self._levelled(axes @ self.rest_accel) @ axes @ self._levelled(self.rest_accel).T
        R_map_imu = begun @ self.attitude.rotation_at(stamp) @ axes.T
        return self._base.rotation(stamp).T @ R_map_imu @ self.R_module_imu.T
