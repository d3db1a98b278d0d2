"""
The shape of a Hall + IMU arm, online: samples of asynchronous modules in, poses and a curve out.

First the robot rests: the gyro biases are averaged and, where the arm starts straight, mounts and
magnet are tared or checked. Then each sample updates its own module; at every due instant of data
time the modules' attitudes and fields give positions (eq. 10, or all jointly) and the curve
through them. A module that is
silent, saturated or frozen is told and left out: its pose is then the backbone's, held by its
neighbours.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from typing import Literal

from continuum_loc import lie
from continuum_loc.errors import CalibrationError, MotionError
from continuum_loc.magnet import FieldModel
from continuum_loc.measurements import FieldSample, ImuSample, nanoseconds, seconds
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import load_settings, Settings
from continuum_loc.shape.attitude import AttitudeSettings, EulerFilter, GravityFilter, level
from continuum_loc.shape.backbone import BackboneFit, BackboneSolver
from continuum_loc.shape.calibration import (
    calibrate,
    Calibration,
    check_wiring,
    load_calibration,
    module_mounts,
    nominal_calibration,
    PosedRest,
    straight_modules,
)
from continuum_loc.shape.curves import arclength, CurveMethod, extended, fit_curve
from continuum_loc.shape.position import PositionSolver
from continuum_loc.shape.rest import Rest, RestWindow
import numpy as np
from pydantic import Field

STALE = 2.5  # sample periods: older readings do not belong to one time
RESUMED_YAW = np.radians(3.0)  # rad, 1 sigma
Status = Literal['taring', 'tracking', 'degraded', 'faulty']


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
    attitude_filter: Literal['so3', 'euler'] = Field(
        'so3', description="euler: the paper's eqs. 3-6, mended"
    )
    field_model: FieldModel = 'ring'
    position: Literal['modules', 'joint'] = Field(
        'modules', description='eq. 10 by module, or one smooth backbone'
    )
    curve: CurveMethod = 'kasa_arc'
    projected: bool = Field(
        False, description="the paper's projected curves instead of the spatial ones"
    )
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
    watch: float = Field(
        0.5, gt=0.0, description='between checks of the wiring by the joint fit [s]'
    )
    misfit: float = Field(
        25.0, gt=1.0, description='normalised misfit of the joint fit from which wiring is suspect'
    )


def load_shape_settings(path: str | Path | None = None) -> ShapeSettings:
    """Load settings from a YAML file, or the defaults."""
    return ShapeSettings() if path is None else load_settings(ShapeSettings, path)


@dataclass(frozen=True, slots=True, eq=False)
class ShapeEstimate:
    """
    The arm at one instant; M modules base to tip, named by their rings.

    T_map_module: (M, 4, 4). covariance: (M, 6, 6) of a right perturbation [rho; phi] (m, rad).
    curve: (C, 3) points in map from the magnet to the tip [m], at arclengths curve_s (C,) [m].
    observable: (M,) whether the module's own field fixes its position. bound: (M, 3) of
    `PositionFit`.
    yaw_sigma: (M,) rad; gravity never corrects yaw, so this only grows.
    faults: what is wrong, by module; empty when all is well. consistency: normalised misfit of the
    joint fit.
    """

    stamp: int
    modules: tuple[str, ...]
    T_map_module: np.ndarray
    covariance: np.ndarray
    curve: np.ndarray
    curve_s: np.ndarray
    observable: np.ndarray
    bound: np.ndarray
    yaw_sigma: np.ndarray
    status: Status
    faults: dict[str, tuple[str, ...]]
    consistency: float


@dataclass(eq=False)
class _Stream:
    """One sensor's last reading, and what its readings look like."""

    stamp: int | None = None
    reading: np.ndarray | None = None
    repeats: int = 0
    saturated: bool = False

    def take(self, stamp: int, reading: np.ndarray, full_scale: np.ndarray) -> bool:
        """Note a reading. False when it is no newer than the last."""
        if self.stamp is not None and stamp <= self.stamp:
            return False
        # nan equals nan.
        same = self.reading is not None and reading.tobytes() == self.reading.tobytes()
        self.repeats = self.repeats + 1 if same else 1
        self.saturated = not (np.abs(reading) < full_scale).all()  # also where an axis is nan
        self.stamp, self.reading = stamp, reading
        return True


@dataclass(eq=False)
class _Module:
    """One module's streams and filter state."""

    name: str
    attitude: GravityFilter | EulerFilter
    imu: _Stream = field(default_factory=_Stream)
    hall: _Stream = field(default_factory=_Stream)
    # total field in the base frame [T], averaged while the module rests
    field_base: np.ndarray | None = None
    averaged: int = 0
    lost: bool = False  # the IMU was silent or frozen: its attitude is stale until it starts again


@dataclass(frozen=True, slots=True, eq=False)
class _Snapshot:
    """
    All modules at one stamp.

    Which are good (M,), R_base_module (M, 3, 3), total fields (M, 3) and the Earth's (3,) in the
    base frame [T], and covariances of the rotations in base axes (M, 3, 3) [rad^2].
    """

    stamp: int
    good: np.ndarray
    R_base_module: np.ndarray
    field_base: np.ndarray
    earth: np.ndarray
    attitude: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Poses (M, 4, 4) with covariances (M, 6, 6), bounds (M, 3) and observability (M,)."""

    T_base_module: np.ndarray
    covariance: np.ndarray
    bound: np.ndarray
    observable: np.ndarray


class ShapeEstimator:
    """
    See the module's docstring.

    `process` takes samples in any order of modules; stamps of one sensor ascend.
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
        self._index = {
            sensor.name: m
            for sensors in (robot.imu, robot.hall)
            for m, sensor in enumerate(sensors)
        }
        self._full_scale = (
            np.repeat([robot.imu_model.gyro_range, robot.imu_model.accel_range], 3),
            np.asarray(robot.hall_model.saturation) + 0.5 * np.asarray(robot.hall_model.lsb),
        )
        self._gain = min(1.0, 1.0 / (robot.hall_model.rate * max(self.settings.smoothing, 1e-9)))
        self.reset()

    def reset(self) -> None:
        """Start over with taring."""
        self.T_map_base = self.robot.base.T_map_base
        self.status: Status = 'taring'
        self.message = ''
        self.counts: Counter[str] = Counter()
        self.faults: dict[str, tuple[str, ...]] = {}
        self._window = RestWindow(self.robot)
        self._window_end: int | None = None
        self._next_due: int | None = None
        self._next_watch: int | None = None
        self._prior = straight_modules(self.robot)
        self._consistency = np.nan
        self._wiring: dict[str, str] = {}
        self._modules = [_Module(ring, self._new_filter()) for ring in self.module_names]
        self._use(self._given or nominal_calibration(self.robot))

    @property
    def module_names(self) -> tuple[str, ...]:
        """Names of the modules' rings, base to tip."""
        return tuple(sensor.ring for sensor in self.robot.hall)

    def process(self, sample: ImuSample | FieldSample) -> ShapeEstimate | None:
        """
        Take one sample; an estimate when one fell due.

        Samples of other sensors are counted and ignored.

        Raises ValueError for a sample that is not finite where a full scale cannot be the reason.
        """
        if not isinstance(sample, (ImuSample, FieldSample)) or sample.sensor not in self._index:
            self.counts['ignored'] += 1
            return None
        module = self._modules[self._index[sample.sensor]]
        if isinstance(sample, ImuSample):
            reading, stream, full = (
                np.concatenate([sample.angular_velocity, sample.linear_acceleration]),
                module.imu,
                0,
            )
            if not np.isfinite(reading).all():
                raise ValueError(
                    f"IMU sample of '{sample.sensor}' at {sample.stamp} is not "
                    f'finite: {reading.tolist()}'
                )
        else:
            reading, stream, full = np.asarray(sample.field, float), module.hall, 1
        if not stream.take(sample.stamp, reading, self._full_scale[full]):
            self.counts['out of order'] += 1
            return None
        self.counts['used'] += 1
        if self.status == 'taring' or self._next_due is None:
            self._tare(sample)
            return None
        if isinstance(sample, ImuSample):
            self._turn(module, sample)
        elif not stream.saturated:
            self._sense(module, sample)
        return self._estimate_if_due(sample.stamp)

    # Taring

    def _new_filter(self) -> GravityFilter | EulerFilter:
        if self.settings.attitude_filter == 'euler':
            return EulerFilter()
        imu = self.robot.imu_model
        return GravityFilter(self.settings.attitude, imu.gyro_sigma, imu.accel_sigma)

    def _tare(self, sample: ImuSample | FieldSample) -> None:
        """Average a rest; motion or wrong wiring is told and taring starts again."""
        if self._window_end is None:
            self._window_end = sample.stamp + nanoseconds(self.settings.taring_seconds)
        if sample.stamp < self._window_end:
            self._window.add(sample)
            return
        window, self._window, self._window_end = self._window, RestWindow(self.robot), None
        try:
            self._begin(window.finish(), sample.stamp)
        except (MotionError, CalibrationError, ValueError) as error:
            self.status, self.message = (
                'taring' if isinstance(error, MotionError) else 'faulty',
                str(error),
            )
            self.counts['taring refused'] += 1

    def _begin(self, rest: Rest, stamp: int) -> None:
        if self.settings.start == 'straight':
            posed = PosedRest(rest, self.T_map_base, straight_modules(self.robot))
            check_wiring(self.robot, posed, self.settings.field_model)
            if self._given is None:
                self._use(calibrate(self.robot, [posed], model=self.settings.field_model))
        yaw_sigma = 0.0 if self.settings.start == 'straight' else np.radians(10.0)
        for m, module in enumerate(self._modules):
            accel = rest.accel[m] - self._accel_offset[m]
            R_map_imu = level(self.T_map_base[:3, :3] @ self._R_module_imu[m], accel)
            module.attitude.start(stamp, R_map_imu, rest.gyro[m], yaw_sigma)
            if np.isfinite(rest.field[m]).all():
                R_base_hall = self._R_base_module(m, stamp) @ self._R_module_hall[m]
                module.field_base, module.averaged = (
                    R_base_hall @ (rest.field[m] - self._hall_offset[m]),
                    rest.samples,
                )
        self.status, self.message, self._next_due, self._next_watch = 'tracking', '', stamp, stamp

    def _use(self, calibration: Calibration) -> None:
        """Set everything that follows from a calibration."""
        self.calibration = calibration
        imu_mount, hall_mount = module_mounts(self.robot)
        columns = {
            name: np.array([getattr(module, name) for module in calibration.modules])
            for name in ('accel_offset', 'imu_turn', 'hall_offset', 'hall_turn')
        }
        self._accel_offset, self._hall_offset = columns['accel_offset'], columns['hall_offset']
        self._R_module_imu = imu_mount @ lie.so3_exp(columns['imu_turn'])
        self._R_module_hall = hall_mount @ lie.so3_exp(columns['hall_turn'])
        magnet = self.robot.magnet.model_copy(update={'remanence': calibration.remanence})
        self._robot = self.robot.model_copy(update={'magnet': magnet})
        s = straight_modules(self.robot)[:, 0, 3]
        self._positions = PositionSolver(magnet, s - magnet.s, self.settings.field_model)
        self._backbone = BackboneSolver(self._robot, s, self.settings.field_model)

    # Samples

    def _turn(self, module: _Module, sample: ImuSample) -> None:
        m = self._index[sample.sensor]
        accel = sample.linear_acceleration - self._accel_offset[m]
        if module.lost:
            if module.imu.repeats > 1:
                return
            self._resume(module, m, sample.stamp, accel)
        module.attitude.update(sample.stamp, sample.angular_velocity, accel)

    def _resume(self, module: _Module, m: int, stamp: int, accel: np.ndarray) -> None:
        """
        Let an IMU that comes back start at the backbone's rotation there.

        The others have kept it.
        """
        module.lost = False
        R_map_imu = level(
            self.T_map_base[:3, :3] @ self._prior[m, :3, :3] @ self._R_module_imu[m], accel
        )
        module.attitude.start(stamp, R_map_imu, module.attitude.bias, RESUMED_YAW)

    def _sense(self, module: _Module, sample: FieldSample) -> None:
        """Smooth the field in the base frame, where it stands still as long as the module does."""
        m = self._index[sample.sensor]
        R_base_hall = self._R_base_module(m, sample.stamp) @ self._R_module_hall[m]
        field_base = R_base_hall @ (sample.field - self._hall_offset[m])
        rate = module.attitude.rate
        if module.averaged == 0 or rate @ rate > self.settings.still**2:
            module.field_base, module.averaged = field_base, 1
        else:
            # The mean of what came since the module rests, then a mean that forgets.
            module.averaged += 1
            gain = max(1.0 / module.averaged, self._gain)
            module.field_base = module.field_base + gain * (field_base - module.field_base)

    def _R_base_module(self, m: int, stamp: int) -> np.ndarray:
        R_map_imu = self._modules[m].attitude.rotation_at(stamp)
        return self.T_map_base[:3, :3].T @ R_map_imu @ self._R_module_imu[m].T

    # Estimates

    def _estimate_if_due(self, stamp: int) -> ShapeEstimate | None:
        if stamp < self._next_due:
            return None
        period = nanoseconds(1.0 / self.settings.rate)
        self._next_due += period * (1 + (stamp - self._next_due) // period)
        return self._estimate(stamp)

    def _estimate(self, stamp: int) -> ShapeEstimate | None:
        self.faults = self._find_faults(stamp)
        now = self._snapshot(stamp)
        if not now.good.any():
            self.status, self.message = 'faulty', 'no module can be used'
            return None
        jointly = self.settings.position == 'joint'
        joint = None
        if jointly or not now.good.all() or stamp >= self._next_watch:
            joint = self._joint(now)
            self._watch(now, joint)
        solution = (
            self._by_module(now, joint)
            if not jointly
            else _Solution(
                joint.T_base_module, joint.covariance, np.zeros((len(now.good), 3), int), now.good
            )
        )
        self._prior = solution.T_base_module
        return self._describe(stamp, solution)

    def _snapshot(self, stamp: int) -> _Snapshot:
        modules = range(len(self._modules))
        good = np.array([module.name not in self.faults for module in self._modules])
        R_base_map = self.T_map_base[:3, :3].T
        return _Snapshot(
            stamp,
            good,
            np.stack([self._R_base_module(m, stamp) for m in modules]),
            np.stack([self._modules[m].field_base if good[m] else np.zeros(3) for m in modules]),
            R_base_map @ self.calibration.earth_field,
            self._attitude_covariance(R_base_map),
        )

    def _find_faults(self, stamp: int) -> dict[str, tuple[str, ...]]:
        """Silent, saturated and frozen modules."""
        found = {}
        for module in self._modules:
            texts = []
            for kind, stream in (('imu', module.imu), ('hall', module.hall)):
                if (
                    stream.stamp is None
                    or seconds(stamp, stream.stamp) > self.settings.silent_after
                ):
                    texts.append(f'{kind} silent')
                elif stream.repeats >= self.settings.frozen_after:
                    texts.append(f'{kind} frozen')
                elif stream.saturated:
                    texts.append(f'{kind} saturated')
            if not texts and module.field_base is None:
                texts.append('hall has not reported yet')
            if texts:
                found[module.name] = tuple(texts)
                module.averaged = 0  # what comes after is another average
            module.lost |= any(text in ('imu silent', 'imu frozen') for text in texts)
        return found

    def _attitude_covariance(self, R_base_map: np.ndarray) -> np.ndarray:
        """(M, 3, 3) of the modules' rotations in base axes, mounting included [rad^2]."""
        mounting = self.calibration.mounting_sigma**2 * np.eye(3)
        return (
            R_base_map
            @ np.stack([module.attitude.covariance for module in self._modules])
            @ R_base_map.T
            + mounting
        )

    def _joint(
        self, now: _Snapshot, order: tuple[int, ...] | None = None, sign: float = 1.0
    ) -> BackboneFit:
        """Fit all modules jointly; `order` and `sign` try another wiring or a reversed magnet."""
        order = list(range(len(now.good)) if order is None else order)
        R, good = now.R_base_module, now.good
        in_module = np.einsum('mji,mj->mi', R, now.field_base)
        # What the calibration leaves in the mounts turns every field, beside the sensor's own
        # noise.
        turned = np.linalg.norm(in_module, axis=1, keepdims=True) * self.calibration.mounting_sigma
        sigma = np.where(
            good[:, None], np.hypot(self.robot.hall_model.sigma, turned), np.inf
        ).repeat(3, axis=1)
        information = np.where(
            good[:, None, None], R.swapaxes(1, 2) @ np.linalg.inv(now.attitude) @ R, 0.0
        )
        return self._backbone.solve(
            sign * in_module[order], sigma[order], sign * now.earth, R[order], information[order]
        )

    def _by_module(self, now: _Snapshot, joint: BackboneFit | None) -> _Solution:
        """Eq. 10 for the good modules, the joint fit's pose for the others."""
        offset = np.array([self.robot.magnet.s, 0.0, 0.0])
        source, prior = now.field_base - now.earth, self._prior[:, :3, 3] - offset
        if joint is not None:
            prior = joint.T_base_module[:, :3, 3] - offset
            # A module left out solves for the field of its own prior, which changes nothing.
            source = np.where(now.good[:, None], source, self._positions.field(prior))
        fit = self._positions.solve(source, prior)
        own, observable = self._positions.covariance(
            fit.position, source, self.robot.hall_model.sigma, now.attitude
        )
        R = now.R_base_module
        T = np.zeros((len(R), 4, 4))
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, fit.position + offset, 1.0
        to_body = np.zeros_like(own)
        to_body[:, :3, :3] = to_body[:, 3:, 3:] = R.swapaxes(1, 2)
        covariance = to_body @ own @ to_body.swapaxes(1, 2)
        if joint is not None:
            T[~now.good], covariance[~now.good] = (
                joint.T_base_module[~now.good],
                joint.covariance[~now.good],
            )
        for m in np.flatnonzero(now.good & fit.ambiguous):
            self.faults[self._modules[m].name] = ('position ambiguous',)
        return _Solution(T, covariance, fit.bound, observable & now.good)

    def _watch(self, now: _Snapshot, joint: BackboneFit) -> None:
        """Judge the wiring by the joint fit, now and then, and only on readings of one time."""
        self._consistency = joint.consistency
        stale = seconds(
            now.stamp, min(min(module.imu.stamp, module.hall.stamp) for module in self._modules)
        )
        if now.stamp >= self._next_watch and stale < STALE / self.robot.hall_model.rate:
            self._next_watch = now.stamp + nanoseconds(self.settings.watch)
            self._wiring = (
                self._suspects(now, joint) if joint.consistency > self.settings.misfit else {}
            )

    def _suspects(self, now: _Snapshot, joint: BackboneFit) -> dict[str, str]:
        """
        Find the reason of a joint fit this bad.

        Try every order of the modules, and the magnet upside down.
        """
        names = self.module_names
        trials = {
            (order, sign): self._joint(now, order, sign).consistency
            for order in permutations(range(len(names)))
            for sign in (1.0, -1.0)
        }
        (order, sign), best = min(trials.items(), key=lambda item: item[1])
        if best > 0.2 * joint.consistency:
            return dict.fromkeys(names, 'does not fit the backbone')
        if sign < 0.0:
            return dict.fromkeys(names, 'magnet upside down')
        return {
            names[which]: f'swapped with {names[place]}'
            for place, which in enumerate(order)
            if place != which
        }

    def _describe(self, stamp: int, solution: _Solution) -> ShapeEstimate:
        for name, text in self._wiring.items():
            self.faults[name] = (*self.faults.get(name, ()), text)
        self.status = 'degraded' if self.faults else 'tracking'
        self.message = '; '.join(
            f'{name}: {", ".join(texts)}' for name, texts in self.faults.items()
        )
        curve = self._curve(solution.T_base_module)
        R, p = self.T_map_base[:3, :3], self.T_map_base[:3, 3]
        yaw = [module.attitude.yaw_sigma for module in self._modules]
        return ShapeEstimate(
            stamp,
            self.module_names,
            self.T_map_base @ solution.T_base_module,
            solution.covariance,
            curve @ R.T + p,
            arclength(curve) + self.robot.magnet.s,
            solution.observable,
            solution.bound,
            np.array(yaw),
            self.status,
            dict(self.faults),
            self._consistency,
        )

    def _curve(self, T_base_module: np.ndarray) -> np.ndarray:
        """(C, 3) from the magnet through the modules to the tip, in the base frame."""
        settings, s = self.settings, self.robot.magnet.s
        points, tangents = np.zeros((2, len(T_base_module) + 1, 3))
        points[0, 0], points[1:] = s, T_base_module[:, :3, 3]
        tangents[0, 0], tangents[1:] = 1.0, T_base_module[:, :3, 0]
        points[:, 0] -= s
        curve = extended(
            fit_curve(points, tangents, settings.curve, settings.projected, settings.curve_points),
            self.robot.length - s,
        )
        curve[:, 0] += s
        return curve
