"""
Sensors other than ToF: true motion in; samples with noise, bias, steps and full scale out.

Each model owns one random stream, so that one sensor's noise does not depend on which others are
simulated.
"""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc import lie
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    StrainSample,
    TrackedPose,
)
from continuum_loc.robot import HallModel, ImuModel, Magnet, Sensor, StrainModel
import numpy as np


@dataclass(frozen=True, slots=True)
class TrackerModel:
    """An EM tracker as NDI's Aurora: near 1 mm and 1 deg, about 50 Hz."""

    rate: float = 50.0
    sigma_position: float = 1e-3
    sigma_rotation: float = float(np.radians(1.0))


TRACKER = TrackerModel()


class ImuSensors:
    """All IMUs of a robot: a constant gyro bias each, white noise, full scale."""

    def __init__(
        self,
        model: ImuModel,
        sensors: tuple[Sensor, ...],
        gravity: float,
        rng: np.random.Generator,
    ) -> None:
        self.model, self.names, self.gravity, self._rng = (
            model,
            [sensor.name for sensor in sensors],
            gravity,
            rng,
        )
        self.gyro_bias = model.gyro_bias_sigma * rng.standard_normal((len(sensors), 3))  # rad/s

    def measure(
        self, stamp: int, T_map_imu: np.ndarray, twist: np.ndarray, acceleration: np.ndarray
    ) -> list[ImuSample]:
        """T_map_imu (I, 4, 4), body twist (I, 6), acceleration in map (I, 3) m/s^2."""
        model = self.model
        specific_force = np.einsum(
            'iab,ia->ib', T_map_imu[:, :3, :3], acceleration + [0.0, 0.0, self.gravity]
        )
        shape = specific_force.shape
        gyro = twist[:, 3:] + self.gyro_bias + model.gyro_sigma * self._rng.standard_normal(shape)
        accel = specific_force + model.accel_sigma * self._rng.standard_normal(shape)
        gyro = np.clip(gyro, -model.gyro_range, model.gyro_range)
        accel = np.clip(accel, -model.accel_range, model.accel_range)
        return [ImuSample(stamp, *row) for row in zip(self.names, gyro, accel, strict=True)]


class StrainSensor:
    """FBG-like bending angle and curvature at stations, noisy as in the paper's section IV-C."""

    def __init__(
        self,
        model: StrainModel,
        stations: np.ndarray,
        nodes_s: np.ndarray,
        rng: np.random.Generator,
    ) -> None:
        self.model, self.stations, self._rng = model, stations, rng
        self.segment = np.clip(np.searchsorted(nodes_s, stations + 1e-9) - 1, 0, len(nodes_s) - 2)

    def measure(self, stamp: int, segment_strain: np.ndarray) -> StrainSample:
        """
        segment_strain: (N, 6) of `motion.segment_strain`.

        The strain is kappa (0, -sin theta, cos theta).
        """
        _, bend_y, bend_z = segment_strain[self.segment, 3:].T
        theta = np.arctan2(-bend_y, bend_z) + self.model.theta_sigma * self._rng.standard_normal(
            len(self.stations)
        )
        kappa = np.hypot(bend_y, bend_z) + self.model.kappa_sigma * self._rng.standard_normal(
            len(self.stations)
        )
        return StrainSample(stamp, self.stations.copy(), theta, kappa)


class HallSensors:
    """Three-axis Hall sensors in the field of the base's ring magnet and the Earth's."""

    def __init__(
        self,
        model: HallModel,
        sensors: tuple[Sensor, ...],
        magnet: Magnet | None,
        earth_field: np.ndarray,
        rng: np.random.Generator,
    ) -> None:
        self.model, self.names, self.magnet, self._rng = (
            model,
            [s.name for s in sensors],
            magnet,
            rng,
        )
        self.earth_field = np.asarray(earth_field, float)

    def measure(
        self, stamp: int, T_map_hall: np.ndarray, T_map_magnet: np.ndarray
    ) -> list[FieldSample]:
        """
        T_map_hall (H, 4, 4).

        Axes beyond full scale read nan; the rest are rounded to the step.
        """
        field = np.einsum(
            'hab,ha->hb', T_map_hall[:, :3, :3], self.true_field(T_map_hall, T_map_magnet)
        )
        field = field + self.model.sigma * self._rng.standard_normal(field.shape)
        lsb = np.asarray(self.model.lsb)
        read = np.where(
            np.abs(field) <= self.model.saturation, np.round(field / lsb) * lsb, np.nan
        )
        return [FieldSample(stamp, name, row) for name, row in zip(self.names, read, strict=True)]

    def true_field(self, T_map_hall: np.ndarray, T_map_magnet: np.ndarray) -> np.ndarray:
        """(H, 3) field in map [T]."""
        total = np.broadcast_to(self.earth_field, (len(T_map_hall), 3))
        if self.magnet is None:
            return total
        from continuum_loc.magnet import ring_field

        p_magnet = (lie.inverse(T_map_magnet) @ T_map_hall)[:, :3, 3]
        return total + ring_field(self.magnet, p_magnet) @ T_map_magnet[:3, :3].T


class Trackers:
    """EM-tracked poses with right-perturbation noise; their covariance is stated."""

    def __init__(
        self, sensors: tuple[Sensor, ...], rng: np.random.Generator, model: TrackerModel = TRACKER
    ) -> None:
        self.names, self.model, self._rng = [s.name for s in sensors], model, rng
        self.sigma = np.repeat([self.model.sigma_position, self.model.sigma_rotation], 3)

    def measure(self, stamp: int, T_map_tracker: np.ndarray) -> list[TrackedPose]:
        """T_map_tracker (P, 4, 4)."""
        noise = self.sigma * self._rng.standard_normal((len(self.names), 6))
        return [
            TrackedPose(stamp, name, T, np.diag(self.sigma**2))
            for name, T in zip(self.names, T_map_tracker @ lie.exp(noise), strict=True)
        ]


class Encoders:
    """Tendon displacement (0 when straight) and force, and insertion unless its sigma is None."""

    def __init__(
        self,
        tendon_names: tuple[str, ...],
        straight_length: np.ndarray,
        sigma: float,
        insertion_sigma: float | None,
        rng: np.random.Generator,
    ) -> None:
        self.insertion, self.straight_length, self._rng = (
            insertion_sigma is not None,
            straight_length,
            rng,
        )
        self.names = tendon_names + (('insertion',) if self.insertion else ())
        self.sigma = np.append(
            np.full(len(tendon_names), sigma), insertion_sigma if self.insertion else []
        )

    def measure(
        self, stamp: int, insertion: float, tendon_length: np.ndarray, tension: np.ndarray
    ) -> EncoderSample:
        """
        Lengths and tensions (K,) in the order of the names.

        A pulled tendon's displacement is negative.
        """
        position = tendon_length - self.straight_length
        if self.insertion:
            position, tension = np.append(position, insertion), np.append(tension, 0.0)
        position = position + self.sigma * self._rng.standard_normal(len(position))
        return EncoderSample(stamp, self.names, position, tension.copy())
