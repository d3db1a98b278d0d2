"""
Calibration of the modules, the magnet and the Earth's field from rests in known poses.

One rest with the straight robot is *taring*; several, with the straight robot turned by the arm
that holds it, are a *calibration*. Both are the same least-squares problem: priors from the
datasheets settle what the rests leave open, and `sigma` says how well each group came out. Taring
alone cannot tell an offset, which turns with the sensor, from the Earth's field, which does not.

    gyro  = b_g
    accel = R_imu^T g + b_a
    field = R_hall^T (R_base B(p; remanence) + b_earth) + b_h
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

from continuum_loc import lie
from continuum_loc.errors import CalibrationError, SettingsError
from continuum_loc.magnet import field_and_gradient, FieldModel
from continuum_loc.robot import RobotDescription, Vector3
from continuum_loc.settings import load_settings, Settings
from continuum_loc.shape.attitude import GRAVITY
from continuum_loc.shape.rest import Rest
import numpy as np
from pydantic import Field
from scipy.optimize import least_squares

ZERO: Vector3 = (0.0, 0.0, 0.0)


class ModuleCalibration(Settings):
    """
    Corrections of one module, in its sensors' frames.

    Rotations turn the mount of the robot description.
    """

    gyro_bias: Vector3 = ZERO
    accel_offset: Vector3 = ZERO
    imu_turn: Vector3 = Field(ZERO, description='rotation vector of the IMU on its mount [rad]')
    hall_offset: Vector3 = ZERO
    hall_turn: Vector3 = Field(
        ZERO, description='rotation vector of the Hall sensor on its mount [rad]'
    )


class Calibration(Settings):
    """What is known of a robot's modules, its magnet and the Earth's field."""

    modules: tuple[ModuleCalibration, ...]
    earth_field: Vector3 = Field(ZERO, description='in map [T]')
    remanence: float = Field(
        description='of the magnet [T]; negative when it is mounted upside down'
    )
    mounting_sigma: float = Field(
        0.0087, ge=0.0, description="left in the modules' rotations, 1 sigma [rad]"
    )

    def check(self, robot: RobotDescription) -> None:
        """Raise SettingsError where this is another robot's calibration."""
        if len(self.modules) != len(robot.hall):
            raise SettingsError(
                f"calibration of {len(self.modules)} modules, but robot '{robot.name}' has "
                f'{len(robot.hall)}'
            )


class CalibrationPriors(Settings):
    """What datasheets and workshop say before any rest (1 sigma)."""

    accel_offset: float = Field(0.4, gt=0.0, description='[m/s^2]')
    hall_offset: float = Field(20e-6, gt=0.0, description='[T]')
    mounting_deg: float = Field(1.0, gt=0.0, description='each chip on its module [deg]')
    earth_field: float = Field(40e-6, gt=0.0, description='each component [T]')
    moment: float = Field(0.1, gt=0.0, description='relative to the robot description')
    pose_deg: float = Field(
        0.05, gt=0.0, description="how well the rests' rotations are known [deg]"
    )


@dataclass(frozen=True, slots=True, eq=False)
class PosedRest:
    """A rest in a known pose: T_map_base (4, 4) and T_base_module (M, 4, 4)."""

    rest: Rest
    T_map_base: np.ndarray
    T_base_module: np.ndarray


def nominal_calibration(robot: RobotDescription) -> Calibration:
    """No corrections: the robot description as it stands."""
    return Calibration(
        modules=tuple(ModuleCalibration() for _ in robot.hall),
        remanence=robot.magnet.remanence,
        mounting_sigma=np.radians(0.5),
    )


def load_calibration(path: str | Path, robot: RobotDescription) -> Calibration:
    """Read a calibration file; raises SettingsError for a bad one or another robot's."""
    calibration = load_settings(Calibration, path)
    calibration.check(robot)
    return calibration


def module_mounts(robot: RobotDescription) -> tuple[np.ndarray, np.ndarray]:
    """
    Rotations of each module's IMU and Hall sensor on their ring, (M, 3, 3) each, base to tip.

    Raises SettingsError unless every Hall sensor has an IMU on its ring.
    """
    if (
        robot.magnet is None
        or not robot.hall
        or [h.ring for h in robot.hall] != [i.ring for i in robot.imu]
    ):
        raise SettingsError(
            f"robot '{robot.name}' cannot sense its shape: it needs a magnet, and an IMU beside "
            f'each Hall sensor; Hall sensors on {[sensor.ring for sensor in robot.hall]}, '
            f'IMUs on {[sensor.ring for sensor in robot.imu]}'
        )
    return (
        np.stack([sensor.mount.T_ring_sensor[:3, :3] for sensor in robot.imu]),
        np.stack([sensor.mount.T_ring_sensor[:3, :3] for sensor in robot.hall]),
    )


class ModuleMounts(NamedTuple):
    """A calibration as the estimator uses it, one row a module: rotations and offsets."""

    R_module_imu: np.ndarray  # (M, 3, 3)
    accel_offset: np.ndarray  # (M, 3) [m/s^2]
    R_module_hall: np.ndarray  # (M, 3, 3)
    hall_offset: np.ndarray  # (M, 3) [T]


def calibrated_mounts(robot: RobotDescription, calibration: Calibration) -> ModuleMounts:
    """Turn the mounts of the robot description by a calibration's corrections."""
    imu_mount, hall_mount = module_mounts(robot)
    accel_offset, imu_turn, hall_offset, hall_turn = (
        np.array([getattr(module, name) for module in calibration.modules])
        for name in ('accel_offset', 'imu_turn', 'hall_offset', 'hall_turn')
    )
    return ModuleMounts(
        imu_mount @ lie.so3_exp(imu_turn),
        accel_offset,
        hall_mount @ lie.so3_exp(hall_turn),
        hall_offset,
    )


def straight_modules(robot: RobotDescription) -> np.ndarray:
    """(M, 4, 4) T_base_module of the straight robot."""
    T = np.tile(np.eye(4), (len(robot.hall), 1, 1))
    T[:, 0, 3] = [robot.sensor_arclength(sensor.name) for sensor in robot.hall]
    return T


def calibrate(
    robot: RobotDescription,
    rests: Sequence[PosedRest],
    priors: CalibrationPriors | None = None,
    model: FieldModel = 'ring',
) -> Calibration:
    """
    Least squares over all rests.

    Raises CalibrationError for a reversed magnet, swapped modules, a saturated channel, or rests
    that do not fit any correction of plausible size.
    """
    if not rests:
        raise CalibrationError('calibration needs at least one rest')
    check_wiring(robot, rests[0], model)
    problem = _Problem(robot, rests, priors or CalibrationPriors(), model)
    solution = least_squares(problem.residuals, np.zeros(problem.size), method='lm', x_scale='jac')
    chi2 = 2.0 * solution.cost / problem.measured
    if chi2 > 10.0:
        raise CalibrationError(
            f'the rests contradict one another: normalised misfit {chi2:.1f} (about 1 expected); '
            "was the robot straight and were the base's poses right?"
        )
    return problem.calibration(solution.x, np.linalg.inv(solution.jac.T @ solution.jac))


def check_wiring(robot: RobotDescription, posed: PosedRest, model: FieldModel = 'ring') -> None:
    """
    Compare a rest with what the robot description predicts, before any fit bends to it.

    Raises CalibrationError for saturation, a magnet mounted upside down, or modules swapped with
    one another.
    """
    finite = np.isfinite(posed.rest.field).all(axis=1)
    saturated = [sensor.name for sensor, good in zip(robot.hall, finite, strict=True) if not good]
    if saturated:
        raise CalibrationError(
            f'saturated at rest: {", ".join(saturated)}; choose a coarser RES or GAIN'
        )
    expected = expected_field(robot, posed.T_base_module, model)
    order = best_assignment(posed.rest.field, expected)
    agreement = np.einsum('mi,mi->m', posed.rest.field[order], expected)
    if (agreement < 0.0).all():
        raise CalibrationError(
            'the magnet is mounted upside down: every module reads the opposite of the expected '
            'field (turn it, or give the remanence in the robot file the other sign)'
        )
    wrong = [
        f'{robot.hall[place].name} reads as {robot.hall[which].name} should'
        for which, place in enumerate(order)
        if which != place
    ]
    if wrong:
        raise CalibrationError(f'modules are swapped: {"; ".join(wrong)}')


def expected_field(
    robot: RobotDescription, T_base_module: np.ndarray, model: FieldModel = 'ring'
) -> np.ndarray:
    """(M, 3) field [T] of the magnet in the Hall sensors' frames, as described."""
    _, hall = module_mounts(robot)
    source = _source(robot, T_base_module[:, :3, 3], model)
    return np.einsum('mji,mj->mi', T_base_module[:, :3, :3] @ hall, source)


def best_assignment(field: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(M,) order, of all there are, such that field[order] fits `expected` (M, 3) in magnitude."""
    measured, wanted = (np.log(np.linalg.norm(b, axis=1) + 1e-9) for b in (field, expected))
    orders = np.array(list(permutations(range(len(field)))))
    return orders[np.argmin(((measured[orders] - wanted) ** 2).sum(axis=1))]


def _source(robot: RobotDescription, p_base: np.ndarray, model: FieldModel) -> np.ndarray:
    """(..., 3) field of the magnet [T] at p_base (..., 3) [m], both in the base frame."""
    p = p_base - np.array([robot.magnet.s, 0.0, 0.0])
    return field_and_gradient(robot.magnet, p, model)[0]


class _Problem:
    """
    Whitened residuals of all rests and priors in unknowns that are scaled to their priors.

    The unknowns are four (M, 3) blocks (accel offset, IMU turn, Hall offset, Hall turn), the
    Earth's field (3,) and the relative change of the moment.
    """

    def __init__(
        self,
        robot: RobotDescription,
        rests: Sequence[PosedRest],
        priors: CalibrationPriors,
        model: FieldModel,
    ) -> None:
        self.robot, self.modules = robot, len(robot.hall)
        self.imu_mount, self.hall_mount = module_mounts(robot)
        turn = np.radians(priors.mounting_deg)
        blocks = np.repeat([priors.accel_offset, turn, priors.hall_offset, turn], 3 * self.modules)
        self.scale = np.concatenate([blocks, np.full(3, priors.earth_field), [priors.moment]])
        self.size = len(self.scale)
        R_map_base = np.stack([posed.T_map_base[:3, :3] for posed in rests])
        T_base_module = np.stack([posed.T_base_module for posed in rests])
        self.R_map_module = R_map_base[:, None] @ T_base_module[:, :, :3, :3]
        source = _source(robot, T_base_module[:, :, :3, 3], model)
        self.source = np.einsum('kij,kmj->kmi', R_map_base, source)  # in map
        self.gyro = np.mean([posed.rest.gyro for posed in rests], axis=0)
        self.accel = np.stack([posed.rest.accel for posed in rests])
        self.field = np.stack([posed.rest.field for posed in rests])
        root = np.sqrt([posed.rest.samples for posed in rests])[:, None, None]
        pose = np.radians(priors.pose_deg)
        self.accel_sigma = np.hypot(robot.imu_model.accel_sigma / root, GRAVITY * pose)
        # Only the Earth's part of the field turns with the base; the magnet turns along.
        # Quantisation does not average out where the noise is below a step.
        step = max(robot.hall_model.lsb) / 12**0.5
        self.field_sigma = np.hypot(
            np.hypot(robot.hall_model.sigma / root, 0.2 * step), 50e-6 * pose
        )
        self.measured = 2 * self.accel.size

    def split(self, unknowns: np.ndarray) -> tuple[np.ndarray, ...]:
        """
        Physical accel offset, IMU turn, Hall offset, Hall turn, Earth, relative moment change.

        The first four are (M, 3), Earth is (3,).
        """
        x = unknowns * self.scale
        return (*x[:-4].reshape(4, self.modules, 3), x[-4:-1], x[-1])

    def residuals(self, unknowns: np.ndarray) -> np.ndarray:
        accel_offset, imu_turn, hall_offset, hall_turn, earth, moment = self.split(unknowns)
        R_imu = self.R_map_module @ (self.imu_mount @ lie.so3_exp(imu_turn))
        R_hall = self.R_map_module @ (self.hall_mount @ lie.so3_exp(hall_turn))
        accel = GRAVITY * R_imu[..., 2, :] + accel_offset
        field = (
            np.einsum('kmji,kmj->kmi', R_hall, (1.0 + moment) * self.source + earth) + hall_offset
        )
        return np.concatenate(
            [
                ((accel - self.accel) / self.accel_sigma).ravel(),
                ((field - self.field) / self.field_sigma).ravel(),
                unknowns,
            ]
        )

    def calibration(self, unknowns: np.ndarray, covariance: np.ndarray) -> Calibration:
        accel_offset, imu_turn, hall_offset, hall_turn, earth, moment = self.split(unknowns)
        modules = tuple(
            ModuleCalibration(
                gyro_bias=tuple(self.gyro[m]),
                accel_offset=tuple(accel_offset[m]),
                imu_turn=tuple(imu_turn[m]),
                hall_offset=tuple(hall_offset[m]),
                hall_turn=tuple(hall_turn[m]),
            )
            for m in range(self.modules)
        )
        sigma = np.sqrt(np.diag(covariance)) * self.scale
        _, imu_turns, _, hall_turns = np.split(sigma[: 12 * self.modules], 4)
        turns = np.concatenate([imu_turns, hall_turns])
        remanence = self.robot.magnet.remanence * (1.0 + moment)
        return Calibration(
            modules=modules,
            earth_field=tuple(earth),
            remanence=remanence,
            mounting_sigma=float(np.sqrt(np.mean(turns**2))),
        )
