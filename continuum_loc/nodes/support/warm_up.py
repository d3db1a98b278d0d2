"""
Compile everything before data flows.

A throw-away filter runs on made-up samples of the robot at rest.
"""

from __future__ import annotations

from collections.abc import Iterator

from continuum_loc.estimator.filter import SlidingWindowFilter
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    Measurement,
    NANOSECONDS,
    nanoseconds,
    StrainSample,
    TOF_VALID,
    TofFrame,
)
from continuum_loc.nodes.support.memory import SeenScene
from continuum_loc.robot import RobotDescription
from continuum_loc.trajectory import Trajectory
import numpy as np

NOISE = 1e-4  # m, rad/s


def rest_samples(
    robot: RobotDescription, duration: float, start: int = NANOSECONDS
) -> Iterator[Measurement]:
    """
    Make samples, in order of their stamps, of a straight robot that rests in a tube of 0.5 m.

    They have a little seeded noise: a sensor that repeats itself to the last bit is refused as
    frozen.
    """
    rng = np.random.default_rng(0)
    tick = 1.0 / max(robot.imu_model.rate, 1.0)
    for step in range(round(duration / tick)):
        stamp = start + nanoseconds(step * tick)
        yield from _inertial(robot, stamp, rng)
        if robot.base.mode == 'measured':
            yield BaseSample(stamp, robot.base.measurement.frame, robot.base.T_map_base)
        if robot.base.insertion.mode == 'measured':
            yield EncoderSample(stamp, ('insertion',), np.zeros(1), np.zeros(1))
        if _due(step, tick, robot.strain.rate if robot.strain else 0.0):
            s = robot.strain_stations
            yield StrainSample(stamp, s, np.zeros_like(s), np.zeros_like(s))
        if _due(step, tick, robot.tof_model.rate):
            yield from _frames(robot, stamp, rng)


def hurried(settings: EstimatorSettings) -> EstimatorSettings:
    """Return settings that use the same kernels, with as little work as there can be."""
    recovery = {
        'suspect_share': 1.0,  # search at once
        'curvature_step': settings.recovery.max_curvature,
        'beam': 1,
        'refined': 1,
    }
    return settings.model_copy(
        update={
            'recovery': settings.recovery.model_copy(update=recovery),
            'health': settings.health.model_copy(update={'clock_start': 0.0}),
            'doubts': settings.doubts.model_copy(update={'enabled': False}),
            'solver': settings.solver.model_copy(
                update={'max_iterations': 2, 'acquisition_iterations': 2}
            ),
        }
    )


def warm_up(
    robot: RobotDescription,
    prior_map: PriorMap | None,
    settings: EstimatorSettings,
    scene: SeenScene,
) -> None:
    """
    Compile every kernel that a filter of these settings and `scene` use.

    Runs such a filter past its first marginalisation, and places what would be seen then. The tube
    is not what the map shows, so that the search for a lost body compiles too.
    """
    filter_ = SlidingWindowFilter(robot, prior_map, hurried(settings))
    duration = 1.3 * settings.window + 0.3
    made = [filter_.process(sample) for sample in rest_samples(robot, duration)]
    estimate = next((one for one in reversed(made) if one is not None), None)
    if estimate is not None and robot.tof:
        frames = list(_frames(robot, estimate.stamp, np.random.default_rng(0)))
        scene.placed(frames, Trajectory.from_estimates([estimate], robot.ring_names))


def _due(step: int, tick: float, rate: float) -> bool:
    return int((step + 1) * tick * rate + 1e-9) > int(step * tick * rate + 1e-9)


def _inertial(
    robot: RobotDescription, stamp: int, rng: np.random.Generator
) -> Iterator[Measurement]:
    for sensor in robot.imu:
        yield ImuSample(stamp, sensor.name, NOISE * rng.normal(size=3), np.array([0.0, 0.0, 9.81]))
    for sensor in robot.hall:
        yield FieldSample(stamp, sensor.name, np.array([1e-4, 0.0, 0.0]))


def _frames(robot: RobotDescription, stamp: int, rng: np.random.Generator) -> Iterator[TofFrame]:
    rays = robot.tof_model.directions
    for sensor in robot.tof:
        ranges = 0.5 + NOISE * rng.normal(size=len(rays))
        yield TofFrame(
            stamp,
            sensor.name,
            ranges[:, None] * rays,
            ranges,
            robot.tof_model.sigma(ranges),
            np.full(len(rays), TOF_VALID, np.uint8),
        )
