"""
Stamped sensor samples, as plain arrays.

They are what `msg_tools` makes of messages and the estimator consumes.

Stamps are integer nanoseconds of the sensor's own clock (the message header), never the arrival
time. All arrays are SI. Nothing here knows ROS.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

NANOSECONDS = 1_000_000_000

# Status codes of the VL53L5CX driver, which `tof/points` carries per zone.
TOF_VALID = 5
TOF_HALF_CONFIDENT = (6, 9)
TOF_NO_TARGET = 255


def seconds(stamp: int, epoch: int = 0) -> float:
    """Time [s] from `epoch` to `stamp`, both in integer ns (exact to 1 ns over days)."""
    return (stamp - epoch) / NANOSECONDS


def nanoseconds(time: float) -> int:
    """Integer nanoseconds of a time in seconds."""
    return round(time * NANOSECONDS)


@dataclass(frozen=True, slots=True, eq=False)
class TofFrame:
    """
    One frame of one multizone time-of-flight sensor.

    points: (Z, 3) in the sensor frame, x along the optical axis, metres; not finite where no
    return.
    ranges: (Z,) distance along the ray, metres: -inf too close, +inf no return, nan invalid
    (REP-117).
    sigma: (Z,) standard deviation the sensor states for each range, metres (nan where it states
    none).
    status: (Z,) uint8, VL53L5CX target status (5 valid; 6 and 9 valid at half confidence).
    """

    stamp: int
    sensor: str
    points: np.ndarray
    ranges: np.ndarray
    sigma: np.ndarray
    status: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """Angular velocity (3,) rad/s, specific force (3,) m/s^2 (+g at rest) in the IMU's frame."""

    stamp: int
    sensor: str
    angular_velocity: np.ndarray
    linear_acceleration: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class StrainSample:
    """
    Bending at M stations.

    Arclength s (M,) m, bending-plane angle theta (M,) rad, curvature kappa (M,) 1/m.

    As in the paper's eqs. 7-8 the strain is Ad(Rx(theta)) [1 0 0 0 0 kappa]: the rotational strain
    is kappa * (0, -sin theta, cos theta).
    """

    stamp: int
    s: np.ndarray
    theta: np.ndarray
    kappa: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class FieldSample:
    """Magnetic field (3,) in tesla in the Hall sensor's frame; nan where an axis is saturated."""

    stamp: int
    sensor: str
    field: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPose:
    """
    An external tracker's pose of a sensor.

    T_map_sensor (4, 4), covariance (6, 6) in [rho; phi] order of a right (sensor-frame)
    perturbation; all-zero covariance means the tracker states none.
    """

    stamp: int
    sensor: str
    T_map_sensor: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True, slots=True, eq=False)
class BaseSample:
    """
    Where a carried base is told to be, at zero insertion.

    T_frame_base (4, 4) in `frame`, which may drift in `map`; covariance (6, 6) in [rho; phi]
    order of a right (base-frame) perturbation, all zero where none is stated.
    """

    stamp: int
    frame: str
    T_frame_base: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True, slots=True, eq=False)
class EncoderSample:
    """
    Joint states by name.

    Tendon displacements (m) and forces (N), base insertion (m, name `insertion`).
    """

    stamp: int
    names: tuple[str, ...]
    position: np.ndarray
    effort: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class TruthSample:
    """
    True poses in `map`.

    T_map_ring (R + 1, 4, 4), the base first, then the rings in the robot's order.
    """

    stamp: int
    T_map_ring: np.ndarray


Measurement = (
    TofFrame | ImuSample | StrainSample | FieldSample | TrackedPose | EncoderSample | BaseSample
)
