"""
Node `shape`: Hall sensors and IMUs in, module poses and the fitted curve out.

See config/shape.yaml.
"""

from __future__ import annotations

import sys
from typing import Any

from continuum_loc.measurements import BaseSample, Measurement
from continuum_loc.nodes.support.progress import compiling
from continuum_loc.nodes.support.runtime import run
from continuum_loc.nodes.support.settings import ShapeNodeSettings
from continuum_loc.nodes.support.worker import ERROR, OK, WARN, WorkerNode
from continuum_loc.robot import RobotDescription
from continuum_loc.shape import load_shape_settings, ShapeEstimate, ShapeEstimator, ShapeSettings
from continuum_loc.simulator.hall_arm import Arm, Motion
from msg_tools.records import PathRecord, PosesRecord
import numpy as np
from std_srvs.srv import Trigger

AFTER_TARING = 1.0  # s of the rehearsal: estimates, and a check of the wiring


class ShapeNode(WorkerNode):
    """The shape estimator on a graph."""

    inputs = ('imu/data_raw', 'imu/mag', 'joint_states', 'base/pose', 'base/odom')

    def __init__(self, **options: Any) -> None:
        super().__init__('shape', ShapeNodeSettings(), **options)
        self.check_parameters()
        self.estimator: ShapeEstimator | None = None
        self.estimate: ShapeEstimate | None = None

    def prepare(self) -> None:
        """Compile the estimator, offer services and outputs."""
        chosen = (
            load_shape_settings(self.settings.settings)
            if self.settings.settings
            else ShapeSettings()
        )
        self.estimator, self.estimate = ShapeEstimator(self.robot, chosen), None
        with compiling(self.get_logger().info):
            rehearse(self.robot, chosen)
        for topic in ('shape/poses', 'shape/curve'):
            self.publisher(topic)
        self.serve(Trigger, '~/reset', self._reset)

    def consume(self, measurement: Measurement) -> int | None:
        """One sample through the estimator; publish when an estimate fell due."""
        estimate = self.estimator.process(measurement)
        if estimate is None:
            return None
        self.estimate = estimate
        self.publish('shape/poses', PosesRecord(estimate.stamp, estimate.T_map_module))
        self.publish('shape/curve', PathRecord(estimate.stamp, frames_along(estimate.curve)))
        return estimate.stamp

    def restart(self) -> None:
        """Start over with taring."""
        self.estimator.reset()
        self.estimate = None

    def describe(self) -> tuple[int, str, dict[str, Any]]:
        """Report a faulty module as an error, taring as a warning."""
        status, faults = self.estimator.status, self.estimator.faults
        values = {
            'status': status,
            'faults': '; '.join(f'{k}: {", ".join(v)}' for k, v in faults.items()) or 'none',
        }
        if self.estimate is not None:
            values |= {
                'consistency': float(self.estimate.consistency),
                'yaw sigma [deg]': float(np.degrees(self.estimate.yaw_sigma.max())),
            }
        if faults:
            return ERROR, values['faults'], values
        if self.estimate is None:
            return WARN, self.estimator.message or status, values
        return OK, 'tracking', values

    def summary(self) -> dict[str, Any]:
        """Add the estimator's own counts."""
        counts = dict(self.estimator.counts) if self.estimator else {}
        return super().summary() | {'estimator': counts}

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.in_worker(self._start_over)
        response.success, response.message = True, 'taring anew: keep the robot at rest'
        return response

    def _start_over(self) -> None:
        self.intake.gate.reset()
        self.restart()


def rehearse(robot: RobotDescription, settings: ShapeSettings) -> ShapeEstimate | None:
    """
    Compile what an estimator uses: one that is thrown away estimates a simulated arm at rest.

    The arm is straight and not yet calibrated, which compiles the taring too.
    """
    own = settings.model_copy(update={'calibration': None, 'start': 'straight'})
    estimator, arm = ShapeEstimator(robot, own), Arm(robot)
    told = ()
    if robot.base.mode == 'measured':
        told = (BaseSample(0, robot.base.measurement.frame, robot.base.T_map_base),)
    at_rest = Motion([arm.posture()], [own.taring_seconds + AFTER_TARING], [0.0])
    made = [estimator.process(sample) for sample in (*told, *arm.record(at_rest))]
    return next((estimate for estimate in reversed(made) if estimate is not None), None)


def frames_along(points: np.ndarray) -> np.ndarray:
    """
    (C, 4, 4) frames on a curve (C, 3).

    x along it, turning as little as possible from the map's axes.
    """
    tangents = np.gradient(points, axis=0)
    x = tangents / np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    seed = np.where(np.abs(x[:, 2:3]) < 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    y = np.cross(seed, x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(points), 1, 1))
    T[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=-1)
    T[:, :3, 3] = points
    return T


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(ShapeNode, args))


if __name__ == '__main__':
    main()
