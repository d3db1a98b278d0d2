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
INT16, UINT16, UINT8 = (-(2**15), 2**15 - 1), (0, 2**16 - 1), (0, 2**8 - 1)
REAL = (int, float, np.number)
MOST_STRAIN = 0.1  # of a fibre, which breaks at half of that


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
    grid, or hold what the sensor's registers cannot.
    """
    rays = model.directions
    distance = 1e-3 * _raw(distance_mm, 'distance_mm', len(rays), INT16)
    status = _raw(target_status, 'target_status', len(rays), UINT8).astype(np.uint8)
    along = distance / rays[:, 0] if model.convention == 'perpendicular' else distance
    seen = np.isin(status, USABLE) & (distance > 0.0)
    none = status == TOF_NO_TARGET
    if nb_target_detected is not None:
        none |= _raw(nb_target_detected, 'nb_target_detected', len(rays), UINT8) == 0
    ranges = np.where(none, np.inf, np.where(seen, along, np.nan))
    ranges = np.where(np.isfinite(ranges) & (ranges < model.min_range), -np.inf, ranges)
    valid = np.isfinite(ranges)
    points = np.where(valid[:, None], rays * np.where(valid, ranges, 0.0)[:, None], np.nan)
    if range_sigma_mm is None:
        sigma = np.full(len(rays), np.nan)
    else:
        stated = 1e-3 * _raw(range_sigma_mm, 'range_sigma_mm', len(rays), UINT16)
        sigma = np.where(valid, stated, np.nan)
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

    The sensitivities are those of its data sheet: at +-500 dps 17.50 mdps per LSB of the gyro, at
    +-4 g 0.122 mg per LSB of the accelerometer. Raises MessageError for what are no three signed
    numbers of 16 bits.
    """
    rate = np.radians(1e-3 * gyro_mdps_per_lsb * _raw(gyro_raw, 'gyro_raw', 3, INT16))
    force = 9.80665e-3 * accel_mg_per_lsb * _raw(accel_raw, 'accel_raw', 3, INT16)
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
    strains, azimuth = np.atleast_2d(_numbers(strains, 'strains')), np.radians(core_azimuth_deg)
    s = _numbers(s, 's')
    if len(azimuth) < 3 or s.ndim != 1 or strains.shape != (len(s), len(azimuth)) or not len(s):
        raise MessageError(
            'size',
            f'fbg: strains of shape {strains.shape} for {s.size} stations and {len(azimuth)} '
            'cores; valid: stations x cores, at least 3 cores',
        )
    if np.abs(strains).max() > MOST_STRAIN:
        raise MessageError(
            'value',
            f'fbg: a strain of {np.abs(strains).max():.3g}; valid: up to {MOST_STRAIN}, without a '
            'unit (microstrain?)',
        )
    cores = np.column_stack(
        [-core_radius * np.cos(azimuth), -core_radius * np.sin(azimuth), np.ones(len(azimuth))]
    )
    y, z, _ = np.linalg.lstsq(cores, strains.T, rcond=None)[0]
    return StrainSample(stamp, s, np.arctan2(z, y), np.hypot(y, z))


def _raw(values: Any, name: str, count: int, limits: tuple[int, int]) -> np.ndarray:
    """(count,) whole numbers within the limits of their register."""
    array = _numbers(values, name).reshape(-1)
    if len(array) != count:
        raise MessageError('size', f'{name}: {len(array)} values; valid: {count}')
    odd = (array < limits[0]) | (array > limits[1]) | (array % 1.0 != 0.0)
    if odd.any():
        value = array[odd][0]
        unsigned = limits == INT16 and 2**15 <= value < 2**16 and value % 1.0 == 0.0
        raise MessageError(
            'value',
            f'{name}: {value:.15g}'
            + (f' (is {value - 2**16:.0f} meant, read without its sign?)' if unsigned else '')
            + f'; valid: whole numbers from {limits[0]} to {limits[1]}',
        )
    return array


def _numbers(values: Any, name: str) -> np.ndarray:
    array = values if isinstance(values, np.ndarray) else np.array(values, object)
    if array.dtype == object:
        odd = [v for v in array.flat if isinstance(v, bool) or not isinstance(v, REAL)]
        if odd:
            raise MessageError('value', f'{name}: holds {str(odd[0])[:40]!r}, which is no number')
    try:
        array = array.astype(float)
    except OverflowError:
        raise MessageError('value', f'{name}: holds a number beyond all limits') from None
    if not np.isfinite(array).all():
        raise MessageError('value', f'{name}: holds a value that is not finite')
    return array
