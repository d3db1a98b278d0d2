"""
Faults of the Hall + IMU arm, one after the other.

Is each told for what it is, and how soon?
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from continuum_loc.measurements import FieldSample, ImuSample, seconds
from continuum_loc.robot import RobotDescription
from continuum_loc.shape import ShapeEstimator, ShapeSettings
from continuum_loc.shape.calibration import calibrate
from continuum_loc.simulator.hall_arm import Arm, bent, groove_motion
import numpy as np

Sample = ImuSample | FieldSample
BEGIN = 3.0  # s into the recording, on the way into the groove
STRAIGHT, ANYHOW = ShapeSettings(), ShapeSettings(start='anyhow')


@dataclass(frozen=True, eq=False)
class Case:
    """
    A fault.

    The word that has to be told, when it begins [s], the settings it is met with, and the samples.
    """

    name: str
    word: str
    begin: float
    settings: ShapeSettings
    samples: list[Sample]


def fault_rows(robot: RobotDescription, seed: int) -> list[dict[str, Any]]:
    """Tell what a calibrated estimator says first in each case, how soon, and if it is right."""
    arm = Arm(robot, seed=seed)
    calibration = calibrate(robot, arm.calibration_rests())
    return [
        _told(ShapeEstimator(robot, case.settings, calibration), case)
        for case in _cases(robot, arm, seed)
    ]


def _told(estimator: ShapeEstimator, case: Case) -> dict[str, Any]:
    for sample in case.samples:
        estimator.process(sample)
        if estimator.message:
            after = seconds(sample.stamp, case.samples[0].stamp) - case.begin
            right = bool(case.word) and case.word in estimator.message and after >= 0.0
            return {
                'fault': case.name,
                'told': estimator.message,
                'after [s]': after,
                'right': right,
            }
    return {'fault': case.name, 'told': '', 'after [s]': np.nan, 'right': not case.word}


def _cases(robot: RobotDescription, arm: Arm, seed: int) -> Iterator[Case]:
    samples = arm.record(groove_motion(arm, bent(robot, 12.5)))
    last = {s.sensor: s for s in samples if seconds(s.stamp, samples[0].stamp) < BEGIN}
    nan_x = np.array([np.nan, 0.0, 0.0])
    yield Case('none', '', 0.0, STRAIGHT, samples)
    yield Case(
        'module silent',
        'module2: imu silent, hall silent',
        BEGIN,
        STRAIGHT,
        _later(samples, 'module2', lambda s: None),
    )
    yield Case(
        'Hall sensor silent',
        'module2: hall silent',
        BEGIN,
        STRAIGHT,
        _later(samples, 'module2_hall', lambda s: None),
    )
    yield Case(
        'Hall sensor saturated',
        'module2: hall saturated',
        BEGIN,
        STRAIGHT,
        _later(samples, 'module2_hall', lambda s: replace(s, field=nan_x)),
    )
    yield Case(
        'Hall sensor frozen',
        'module2: hall frozen',
        BEGIN,
        STRAIGHT,
        _later(samples, 'module2_hall', lambda s: replace(last[s.sensor], stamp=s.stamp)),
    )
    yield Case(
        'IMU frozen',
        'module2: imu frozen',
        BEGIN,
        STRAIGHT,
        _later(samples, 'module2_imu', lambda s: replace(last[s.sensor], stamp=s.stamp)),
    )
    swapped = [replace(s, sensor=_exchange(s.sensor, 'module1', 'module3')) for s in samples]
    yield Case('modules 1 and 3 swapped, tared straight', 'swapped', 0.0, STRAIGHT, swapped)
    yield Case('modules 1 and 3 swapped, start anyhow', 'swapped', 0.0, ANYHOW, swapped)
    turned = Arm(robot, seed=seed)
    turned.magnet = arm.magnet.model_copy(update={'remanence': -arm.magnet.remanence})
    upside_down = turned.record(groove_motion(turned, bent(robot, 12.5)))
    yield Case('magnet upside down, tared straight', 'upside down', 0.0, STRAIGHT, upside_down)
    yield Case('magnet upside down, start anyhow', 'upside down', 0.0, ANYHOW, upside_down)
    yield Case(
        'motion during taring',
        'motion during taring',
        0.0,
        STRAIGHT,
        arm.record(groove_motion(arm, bent(robot, 12.5), rest=0.3)),
    )


def _later(
    samples: list[Sample], sensor: str, change: Callable[[Sample], Sample | None]
) -> list[Sample]:
    """Change the samples of sensors beginning with `sensor` from `BEGIN` on; None drops one."""
    begin = samples[0].stamp
    changed = (
        change(s) if s.sensor.startswith(sensor) and seconds(s.stamp, begin) >= BEGIN else s
        for s in samples
    )
    return [s for s in changed if s is not None]


def _exchange(name: str, a: str, b: str) -> str:
    if name.startswith(a):
        return name.replace(a, b)
    return name.replace(b, a)
