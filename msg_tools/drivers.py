"""
From a sensor driver's raw fields to measurements.

What a driver node of one's own calls before it publishes.

frame = vl53l5cx_frame(robot.tof_model, "ring1_tof1", stamp, distance_mm, target_status,
range_sigma_mm) publisher.publish(tof_message(ros_messages(), frame))
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from continuum_loc.errors import MessageError
from continuum_loc.measurements import (
    ImuSample,
    StrainSample,
    TOF_HALF_CONFIDENT,
    TOF_NO_TARGET,
    TOF_VALID,
    TofFrame,
)
from continuum_loc.robot import TofModel
import numpy as np

USABLE = (TOF_VALID, *TOF_HALF_CONFIDENT)


def vl53l5cx_frame(
    model: TofModel,
    sensor: str,
    stamp: int,
    distance_mm: Sequence[int],
    target_status: Sequence[int],
    range_sigma_mm: Sequence[int] | None = None,
    nb_target_detected: Sequence[int] | None = None,
) -> TofFrame:
    """
    Make a frame of the VL53L5CX from its driver's arrays, one value per zone.

    Values are in the driver's order.

    model: of the robot description. Its `convention` says what the raw distance means: this sensor
    reports the *perpendicular* distance. Its `flip_rows`, `flip_columns` undo the lens. stamp: ns
    of the exposure. A zone without a target becomes +inf, one with another status than 5, 6 or 9
    nan: its distance means nothing. Raises MessageError where the arrays do not fit the model's
    grid.
    """
    rays = model.directions
    distance = 1e-3 * _per_zone(distance_mm, 'distance_mm', len(rays))
    status = _per_zone(target_status, 'target_status', len(rays)).astype(np.uint8)
    along = distance / rays[:, 0] if model.convention == 'perpendicular' else distance
    seen = np.isin(status, USABLE) & (distance > 0.0)
    none = status == TOF_NO_TARGET
    if nb_target_detected is not None:
        none |= _per_zone(nb_target_detected, 'nb_target_detected', len(rays)) == 0
    ranges = np.where(none, np.inf, np.where(seen, along, np.nan))
    ranges = np.where(np.isfinite(ranges) & (ranges < model.min_range), -np.inf, ranges)
    valid = np.isfinite(ranges)
    points = np.where(valid[:, None], rays * np.where(valid, ranges, 0.0)[:, None], np.nan)
    if range_sigma_mm is None:
        sigma = np.full(len(rays), np.nan)
    else:
        sigma = np.where(
            valid, 1e-3 * _per_zone(range_sigma_mm, 'range_sigma_mm', len(rays)), np.nan
        )
    return TofFrame(stamp, sensor, points, ranges, sigma, status)


def ism330_sample(
    sensor: str,
    stamp: int,
    gyro_raw: Sequence[int],
    accel_raw: Sequence[int],
    gyro_mdps_per_lsb: float,
    accel_mg_per_lsb: float,
) -> ImuSample:
    """
    Make an IMU sample from the ISM330's (or LSM6's) raw registers.

    By the sensitivities of its data sheet.

    At +-500 dps the gyro's is 17.50 mdps per LSB, at +-4 g the accelerometer's 0.122 mg per LSB.
    """
    rate = np.radians(1e-3 * gyro_mdps_per_lsb * _per_zone(gyro_raw, 'gyro_raw', 3))
    force = 9.80665e-3 * accel_mg_per_lsb * _per_zone(accel_raw, 'accel_raw', 3)
    return ImuSample(stamp, sensor, rate, force)


def fbg_sample(
    stamp: int,
    s: Sequence[float],
    strains: Sequence[Sequence[float]],
    core_azimuth_deg: Sequence[float],
    core_radius: float,
) -> StrainSample:
    """
    Bending at M stations of a multi-core fibre, from the axial strain of its C >= 3 outer cores.

    strains: (M, C) relative to straight, dimensionless (1e-6 per microstrain). A core at azimuth a
    and radius r is strained by -kappa r cos(a - theta') + common; a least-squares fit gives both
    and leaves out temperature and tension. The bending plane theta is the direction towards which
    the backbone curves, from body y towards z.
    """
    strains, azimuth = (
        np.atleast_2d(np.asarray(strains, float)),
        np.radians(np.asarray(core_azimuth_deg, float)),
    )
    if len(azimuth) < 3 or strains.shape != (len(s), len(azimuth)):
        raise MessageError(
            'size',
            f'fbg: strains of shape {strains.shape} for {len(s)} stations and {len(azimuth)} '
            'cores; valid: stations x cores, at least 3 cores',
        )
    if not np.isfinite(strains).all():
        raise MessageError('value', 'fbg: a strain is not finite')
    cores = np.column_stack(
        [-core_radius * np.cos(azimuth), -core_radius * np.sin(azimuth), np.ones(len(azimuth))]
    )
    y, z, _ = np.linalg.lstsq(cores, strains.T, rcond=None)[0]
    return StrainSample(stamp, np.asarray(s, float), np.arctan2(z, y), np.hypot(y, z))


def _per_zone(values: Any, name: str, count: int) -> np.ndarray:
    array = np.asarray(values, float).reshape(-1)
    if len(array) != count:
        raise MessageError('size', f'{name}: {len(array)} values; valid: {count}')
    return array
