"""The initial rest: while the body does not move, a gyro's average rate is its bias."""

from __future__ import annotations

from continuum_loc import lie
from continuum_loc.estimator.settings import GyroSettings
from continuum_loc.estimator.state import Grid
from continuum_loc.estimator.window import Window
from continuum_loc.measurements import ImuSample, Measurement
from continuum_loc.robot import RobotDescription
import numpy as np

REST_TURN = 0.005  # [rad] a body that turned farther during the initial rest was not at rest
REST_SIGMA = 0.002  # [rad/s] how well rest is rest
LEAST_SAMPLES = 10


class InitialRest:
    """Collects the gyros' first samples and tells the window their mean, unless the body moved."""

    def __init__(self, robot: RobotDescription, grid: Grid, settings: GyroSettings):
        self._robot, self._grid, self._settings = robot, grid, settings
        self._rates: dict[str, list[np.ndarray]] | None = {} if settings.rest_time > 0.0 else None

    def note(self, measurement: Measurement) -> None:
        """Take a sample, while the rest lasts."""
        if self._rates is not None and isinstance(measurement, ImuSample):
            self._rates.setdefault(measurement.sensor, []).append(measurement.angular_velocity)

    def finish(self, window: Window, time: float) -> None:
        """Once `rest_time` is over, enter the means as observations of the biases, once."""
        if self._rates is None or time < self._settings.rest_time:
            return
        rates, self._rates = self._rates, None
        if window.pinned:
            return
        weight, mean = np.zeros(3 * self._grid.biases), np.zeros(3 * self._grid.biases)
        turned = np.linalg.norm(
            lie.so3_log(
                np.swapaxes(window.column(0).T[:, :3, :3], 1, 2) @ window.column(-1).T[:, :3, :3]
            ),
            axis=1,
        )
        for number, imu in enumerate(self._robot.imu):
            samples = np.array(rates.get(imu.name, []))
            node = self._grid.node_at(self._robot.sensor_arclength(imu.name))
            if turned[node] > REST_TURN or not self._steady(samples):
                continue
            at = slice(3 * number, 3 * number + 3)
            weight[at] = 1.0 / (self._robot.imu_model.gyro_sigma**2 / len(samples) + REST_SIGMA**2)
            mean[at] = imu.mount.T_ring_sensor[:3, :3] @ np.mean(samples, axis=0)
        window.observe_bias(weight, mean)

    def _steady(self, samples: np.ndarray) -> bool:
        return (
            len(samples) >= LEAST_SAMPLES
            and float(np.max(np.std(samples, axis=0))) <= self._settings.rest_rate
        )
