"""Settings of the shape estimator."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from continuum_loc.magnet import FieldModel
from continuum_loc.settings import load_settings, Settings
from continuum_loc.shape.attitude import AttitudeSettings
from continuum_loc.shape.curves import CurveMethod
from pydantic import Field


class ShapeSettings(Settings):
    """Settings of the Hall + IMU shape estimator."""

    rate: float = Field(25.0, gt=0.0, description='estimates per second of data time [Hz]')
    start: Literal['straight', 'anyhow'] = Field(
        'straight',
        description='shape during taring: straight also tares mounts and checks the wiring; '
        "anyhow only averages the gyro bias, and yaw then starts from the base's",
    )
    taring_seconds: float = Field(1.0, gt=0.0, description='rest at the start [s]')
    calibration: Path | None = Field(
        None, description='file of `calibrate`; none: tare at the start'
    )
    attitude: AttitudeSettings = AttitudeSettings()
    field_model: FieldModel = 'ring'
    position: Literal['modules', 'joint'] = Field(
        'modules', description='eq. 10 by module, or one smooth backbone'
    )
    curve: CurveMethod = 'kasa_arc'
    curve_points: int = Field(61, ge=4, description='points along the curve up to the last module')
    smoothing: float = Field(
        0.5, ge=0.0, description="time constant of the field's average while a module rests [s]"
    )
    still: float = Field(0.006, gt=0.0, description='a module turning slower rests [rad/s]')
    silent_after: float = Field(
        0.1, gt=0.0, description='a module without samples for longer is silent [s]'
    )
    frozen_after: int = Field(
        10, ge=2, description='as many equal readings in a row are a frozen sensor'
    )
    watch: float = Field(0.5, gt=0.0, description='between checks of axes, units and wiring [s]')
    misfit: float = Field(
        25.0, gt=1.0, description='normalised misfit of the joint fit from which wiring is suspect'
    )


def load_shape_settings(path: str | Path | None = None) -> ShapeSettings:
    """Load settings from a YAML file, or the defaults."""
    return ShapeSettings() if path is None else load_settings(ShapeSettings, path)
