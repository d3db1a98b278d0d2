"""What is wrong with single sensors: silent, frozen, saturated, in another unit, turned."""

from __future__ import annotations

from collections.abc import Sequence

from continuum_loc import plausible
from continuum_loc.magnet import FieldModel
from continuum_loc.measurements import seconds
from continuum_loc.robot import RobotDescription
from continuum_loc.shape.calibration import (
    expected_field,
    module_mounts,
    PosedRest,
    straight_modules,
)
from continuum_loc.shape.estimate import Faults
from continuum_loc.shape.modules import Module
from continuum_loc.shape.rest import RestWindow
from continuum_loc.shape.settings import ShapeSettings
import numpy as np

BACKGROUND = 100e-6  # T: the Earth's field and a sensor's offset, at most
BENT = 10.0  # a module that is nearer or at the magnet's side reads so much more, or less
MISMOUNTED = np.radians(30.0)  # rad: no chip is off by so much without being turned


def stream_faults(modules: Sequence[Module], stamp: int, settings: ShapeSettings) -> Faults:
    """Silent, saturated and frozen modules. Their averages begin anew."""
    found = {}
    for module in modules:
        texts = _texts(module, stamp, settings)
        if texts:
            found[module.name] = texts
            module.averaged = 0
        module.lost |= any(text in ('imu silent', 'imu frozen') for text in texts)
    return found


def _texts(module: Module, stamp: int, settings: ShapeSettings) -> tuple[str, ...]:
    texts = []
    for kind, stream in (('imu', module.imu), ('hall', module.hall)):
        if stream.stamp is None or seconds(stamp, stream.stamp) > settings.silent_after:
            texts.append(f'{kind} silent')
        elif stream.repeats >= settings.frozen_after:
            texts.append(f'{kind} frozen')
        elif stream.saturated:
            texts.append(f'{kind} saturated')
    if not texts and module.field_base is None:
        texts.append('hall has not reported yet')
    return tuple(texts)


def unit_faults(robot: RobotDescription, window: RestWindow) -> Faults:
    """Sensors whose readings of a rest are in another unit, whatever the robot's shape."""
    expected = np.linalg.norm(expected_field(robot, straight_modules(robot)), axis=1)
    least = max(0.0, expected.min() - BACKGROUND) / BENT
    most = (expected.max() + BACKGROUND) * BENT
    faults = {}
    for imu, hall, size in zip(robot.imu, robot.hall, expected, strict=True):
        texts = {
            'hall': plausible.field_strength(
                window.readings('field', hall.name), size, least, most
            ),
            'imu': plausible.acceleration(window.readings('accel', imu.name)),
        }
        # A gyro that is shaken is noisy too, but then the accelerometer is as well.
        if not texts['imu'] and not window.motion('accel', imu.name):
            gyro = window.readings('gyro', imu.name)
            texts['imu'] = plausible.gyro_noise(gyro, robot.imu_model.gyro_sigma)
        _note(faults, hall.ring, texts)
    return faults


def axis_faults(robot: RobotDescription, posed: PosedRest, model: FieldModel) -> Faults:
    """Sensors that read gravity or the magnet along another axis than at the straight robot."""
    imu, _ = module_mounts(robot)
    R_map_module = posed.T_map_base[:3, :3] @ posed.T_base_module[:, :3, :3]
    up = (R_map_module @ imu)[:, 2]
    field = expected_field(robot, posed.T_base_module, model)
    faults = {}
    for m, sensor in enumerate(robot.hall):
        texts = {'imu': plausible.direction(posed.rest.accel[m], up[m], 'gravity', MISMOUNTED)}
        background = BACKGROUND / np.linalg.norm(field[m])
        if background < 0.7:  # elsewhere the Earth's field decides the direction
            texts['hall'] = plausible.direction(
                posed.rest.field[m], field[m], 'the magnet', MISMOUNTED + np.arcsin(background)
            )
        _note(faults, sensor.ring, texts)
    return faults


def _note(faults: Faults, module: str, texts: dict[str, str]) -> None:
    """Add what was found out of a module's sensors."""
    found = tuple(f'{kind} {text}' for kind, text in texts.items() if text)
    if found:
        faults[module] = found
