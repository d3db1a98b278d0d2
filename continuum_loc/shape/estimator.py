"""
The shape of a Hall + IMU arm, online: samples of asynchronous modules in, poses and a curve out.

First the robot rests (`taring`): gyro biases are averaged, and where the arm starts straight,
mounts and magnet are tared or checked. Then each sample updates its own module (`modules`, eqs.
3-9). At every due instant of data time the attitudes and fields of all modules give poses
(`poses`, eq. 10) and the curve through them (`estimate`, eqs. 11-24). A module that is silent,
saturated or frozen (`faults`), or whose sensors cannot be what they claim (`watch`), is told and
left out: its pose is then the backbone's, held by its neighbours.
"""

from __future__ import annotations

from collections import Counter

from continuum_loc.errors import MeasurementError
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    nanoseconds,
)
from continuum_loc.robot import RobotDescription
from continuum_loc.shape.base_motion import BaseMotion
from continuum_loc.shape.calibration import (
    calibrated_mounts,
    Calibration,
    load_calibration,
    module_mounts,
    straight_modules,
)
from continuum_loc.shape.estimate import (
    curve_through,
    described,
    Faults,
    ShapeEstimate,
    Status,
)
from continuum_loc.shape.faults import stream_faults
from continuum_loc.shape.modules import Module
from continuum_loc.shape.poses import ModulePoses, PoseSolver
from continuum_loc.shape.settings import ShapeSettings
from continuum_loc.shape.taring import Tared, Taring
from continuum_loc.shape.watch import Watch
import numpy as np


class ShapeEstimator:
    """
    See the module's docstring.

    `process` takes samples in any order of modules; stamps of one sensor ascend. status, message,
    faults (what is wrong, by module) and counts tell how it goes, whether an estimate came or not.
    """

    def __init__(
        self,
        robot: RobotDescription,
        settings: ShapeSettings | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        self.robot, self.settings = robot, settings or ShapeSettings()
        module_mounts(robot)  # refuses a robot without modules
        if calibration is None and self.settings.calibration is not None:
            calibration = load_calibration(self.settings.calibration, robot)
        if calibration is not None:
            calibration.check(robot)
        self._given = calibration
        self.reset()

    def reset(self) -> None:
        """Start over with taring."""
        places = range(len(self.robot.hall))
        self.status: Status = 'taring'
        self.message = ''
        self.faults: Faults = {}
        self.counts: Counter[str] = Counter()
        self._base = BaseMotion(self.robot)
        self._modules = [Module(m, self.robot, self.settings, self._base) for m in places]
        self._by_sensor = {
            sensors[m].name: self._modules[m]
            for m in places
            for sensors in (self.robot.imu, self.robot.hall)
        }
        self._taring: Taring | None = Taring(self.robot, self.settings, self._given, self._base)
        self._latest = straight_modules(self.robot)  # T_base_module of the last estimate

    @property
    def module_names(self) -> tuple[str, ...]:
        """Names of the modules' rings, base to tip."""
        return tuple(sensor.ring for sensor in self.robot.hall)

    def process(
        self, sample: ImuSample | FieldSample | BaseSample | EncoderSample
    ) -> ShapeEstimate | None:
        """
        Take one sample; an estimate when one fell due.

        Where the base is, and how far inserted, is noted for those of the modules that follow.
        Samples of other sensors are counted and ignored. Raises MeasurementError for an IMU sample
        that is not finite: no full scale can be the reason.
        """
        if isinstance(sample, (BaseSample, EncoderSample)):
            self.counts['used' if self._base.take(sample) else 'ignored'] += 1
            return None
        module = self._by_sensor.get(getattr(sample, 'sensor', None))
        if module is None or not isinstance(sample, (ImuSample, FieldSample)):
            self.counts['ignored'] += 1
            return None
        if not self._noted(module, sample):
            self.counts['out of order'] += 1
            return None
        self.counts['used'] += 1
        if self._taring is not None:
            self._tare(self._taring, sample)
            return None
        if isinstance(sample, ImuSample):
            module.turn(sample, self._latest[module.place, :3, :3])
        elif not module.hall.saturated:
            module.sense(sample)
        return self._estimate(sample.stamp) if sample.stamp >= self._next_due else None

    def _noted(self, module: Module, sample: ImuSample | FieldSample) -> bool:
        """Note a reading in its stream; False for one that is no newer than the last."""
        if isinstance(sample, FieldSample):
            return module.hall.take(sample.stamp, np.asarray(sample.field, float))
        reading = np.concatenate([sample.angular_velocity, sample.linear_acceleration])
        if not reading @ reading < np.inf:
            raise MeasurementError(
                'not finite',
                f"IMU sample of '{sample.sensor}' at {sample.stamp} is not "
                f'finite: {reading.tolist()}',
            )
        return module.imu.take(sample.stamp, reading)

    def _tare(self, taring: Taring, sample: ImuSample | FieldSample) -> None:
        tared = taring.add(sample)
        if tared is not None:
            self._begin(tared, sample.stamp)
        elif taring.over:
            self.counts['taring refused'] += 1
            self.status, self.message, self.faults = taring.status, taring.message, taring.faults

    def _begin(self, tared: Tared, stamp: int) -> None:
        self.calibration = tared.calibration
        mounts = calibrated_mounts(self.robot, tared.calibration)
        for module in self._modules:
            module.use(mounts)
            module.start(stamp, tared.rest, tared.yaw_sigma)
        self._solver = PoseSolver(self.robot, tared.calibration, self.settings, self._base)
        self._watch = Watch(self.robot, self.settings, self._solver, self._modules)
        self._taring, self._next_due = None, stamp
        self.status, self.message, self.faults = 'tracking', '', {}

    def _estimate(self, stamp: int) -> ShapeEstimate | None:
        period = nanoseconds(1.0 / self.settings.rate)
        self._next_due += period * (1 + (stamp - self._next_due) // period)
        self.faults = stream_faults(self._modules, stamp, self.settings)
        if len(self.faults) == len(self._modules):
            self.status, self.message = 'faulty', 'no module can be used'
            return None
        poses = self._poses(stamp)
        self._latest = poses.T_base_module
        return self._described(stamp, poses)

    def _poses(self, stamp: int) -> ModulePoses:
        """Eq. 10, or the joint fit; that one also where a module is left out, and to look at."""
        now = self._solver.snapshot(self._modules, self._usable(), stamp)
        jointly, joint = self.settings.position == 'joint', None
        if jointly or not now.good.all() or self._watch.due(stamp):
            joint = self._solver.joint(now)
            self._watch.look(now, joint)
        if jointly:
            return self._solver.jointly(now, joint)
        return self._solver.by_module(now, self._latest, joint)

    def _usable(self) -> np.ndarray:
        """(M,) modules whose streams are well, less those accused as long as others are left."""
        well = np.array([name not in self.faults for name in self.module_names])
        trusted = well & [name not in self._watch.turned for name in self.module_names]
        return trusted if trusted.any() else well

    def _described(self, stamp: int, poses: ModulePoses) -> ShapeEstimate:
        for module in self._modules:
            if poses.ambiguous[module.place]:
                self.faults[module.name] = ('position ambiguous',)
        for name, texts in self._watch.faults.items():
            self.faults[name] = (*self.faults.get(name, ()), *texts)
        self.status = 'degraded' if self.faults else 'tracking'
        self.message = described(self.faults)
        T_map_base = self._base.pose(stamp)
        curve, curve_s = curve_through(poses.T_base_module, T_map_base, self.robot, self.settings)
        return ShapeEstimate(
            stamp,
            self.module_names,
            T_map_base @ poses.T_base_module,
            poses.covariance,
            curve,
            curve_s,
            poses.observable,
            poses.bound,
            np.array([module.attitude.yaw_sigma for module in self._modules]),
            self.status,
            dict(self.faults),
            self._watch.consistency,
            T_map_base,
        )
