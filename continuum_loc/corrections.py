"""
What a sensor read, as one that is exactly as described would have read it.

The description says how each unit departs: `range_offset` and `range_scale` of a ToF sensor,
`gyro_axes` and `gyro_bias` of an IMU, scale, twist and offset of a strain sensor, and `clock` of
each. They are taken off where a measurement enters, once, so that nobody behind has to know.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from continuum_loc.measurements import (
    ImuSample,
    Measurement,
    nanoseconds,
    StrainSample,
    TofFrame,
)
from continuum_loc.robot import ImuSensor, RobotDescription, StrainModel, TofModel, TofSensor
import numpy as np

Correction = Callable[[Measurement], Measurement]


class Corrections:
    """What to take off the measurements of one robot; nothing where all is as described."""

    def __init__(self, robot: RobotDescription):
        self._of: dict[str, list[Correction]] = {}
        for tof in robot.tof:
            self._add(tof.name, _of_tof(tof, robot.tof_model), tof.clock)
        for imu in robot.imu:
            self._add(imu.name, _of_gyro(imu), imu.clock)
        for sensor in (*robot.hall, *robot.trackers):
            self._add(sensor.name, None, sensor.clock)
        if robot.strain is not None:
            self._add('strain', _of_strain(robot.strain), robot.strain.clock)

    def _add(self, name: str, correction: Correction | None, clock: float) -> None:
        found = [correction] if correction is not None else []
        if clock != 0.0:
            found.append(_of_clock(clock))
        if found:
            self._of[name] = found

    def applied(self, measurement: Measurement) -> Measurement:
        """Return the measurement as an exact sensor would have given it."""
        name = (
            'strain'
            if isinstance(measurement, StrainSample)
            else getattr(measurement, 'sensor', '')
        )
        for correct in self._of.get(name, ()):
            measurement = correct(measurement)
        return measurement


def _of_clock(clock: float) -> Correction:
    late = nanoseconds(clock)
    return lambda measurement: replace(measurement, stamp=measurement.stamp + late)


def _of_tof(sensor: TofSensor, model: TofModel) -> Correction | None:
    offset, scale = sensor.range_offset, sensor.range_scale
    if offset == 0.0 and scale == 1.0:
        return None
    along = offset / measured_share(model)

    def correct(frame: Measurement) -> Measurement:
        if not isinstance(frame, TofFrame) or len(frame.ranges) != len(along):
            return frame
        finite = np.isfinite(frame.ranges)
        read = np.where(finite, frame.ranges, 1.0)
        share = np.maximum((read - along) / scale, 0.0) / np.maximum(read, 1e-9)
        return replace(
            frame,
            points=frame.points * share[:, None],
            ranges=np.where(finite, share * frame.ranges, frame.ranges),
        )

    return correct


def measured_share(model: TofModel) -> np.ndarray:
    """(Z,) distance that a unit measures over the range along each zone's ray."""
    if model.convention == 'perpendicular':
        return model.directions[:, 0]
    return np.ones(model.rows * model.columns)


def _of_gyro(imu: ImuSensor) -> Correction | None:
    axes, bias = np.array(imu.gyro_axes), np.array(imu.gyro_bias)
    if np.array_equal(axes, np.eye(3)) and not bias.any():
        return None
    back = np.linalg.inv(axes)

    def correct(sample: Measurement) -> Measurement:
        if not isinstance(sample, ImuSample):
            return sample
        return replace(sample, angular_velocity=back @ (sample.angular_velocity - bias))

    return correct


def _of_strain(model: StrainModel) -> Correction | None:
    if model.scale == 1.0 and model.twist_deg == 0.0 and not any(model.offset):
        return None
    gain = model.scale * np.exp(1j * np.radians(model.twist_deg))
    offset = complex(*model.offset)

    def correct(sample: Measurement) -> Measurement:
        if not isinstance(sample, StrainSample):
            return sample
        # Bending about y and z is one complex number, i kappa exp(i theta).
        bent = (1j * sample.kappa * np.exp(1j * sample.theta) - offset) / gain
        return replace(sample, theta=np.angle(bent / 1j), kappa=np.abs(bent))

    return correct
