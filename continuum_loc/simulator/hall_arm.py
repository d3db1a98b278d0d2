"""
Samples of a Hall + IMU arm in exactly known shapes: grooves, S-shapes, bending out of a plane.

The arm is a chain of short arcs of constant strain, `PIECES` from each module to the next and to
the tip. A motion holds a posture or passes smoothly to the next. The field is the true ring
magnet's and the Earth's; chips are mounted askew, have offsets, noise, quantisation steps and full
scales, and every module keeps its own clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from continuum_loc import lie
from continuum_loc.magnet import ring_field
from continuum_loc.measurements import FieldSample, ImuSample, NANOSECONDS, nanoseconds
from continuum_loc.robot import RobotDescription, Vector3
from continuum_loc.settings import Settings
from continuum_loc.shape.attitude import GRAVITY
from continuum_loc.shape.calibration import module_mounts, PosedRest, straight_modules
from continuum_loc.shape.rest import RestWindow
import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation, Slerp

PIECES = 6
# Curvature by groove diameter [1/m].
GROOVES = {
    'straight': 0.0,
    '160 mm': 1.0 / 0.080,
    '80 mm': 1.0 / 0.040,
}


class Imperfections(Settings):
    """What the true arm has and its description does not say: sigmas, 0 if perfect."""

    mounting_deg: float = Field(
        0.5, ge=0.0, description='turn of every chip, about a random axis [deg]'
    )
    hall_offset: float = Field(10e-6, ge=0.0, description='zero-field offset [T]')
    accel_offset: float = Field(
        0.25, ge=0.0, description='zero-g offset, MPU6050: 50 mg is 0.49 [m/s^2]'
    )
    moment: float = Field(
        0.02, ge=0.0, description="magnet's moment against the description, relative"
    )
    base_pose_deg: float = Field(0.05, ge=0.0, description='of the arm that turns the base [deg]')
    earth_field: Vector3 = Field((20e-6, 3e-6, -43e-6), description='in map [T]')
    noise: float = Field(
        1.0, ge=0.0, description="scales the datasheet's white noise and gyro bias"
    )


PERFECT = Imperfections(
    mounting_deg=0.0,
    hall_offset=0.0,
    accel_offset=0.0,
    moment=0.0,
    base_pose_deg=0.0,
    earth_field=(0.0, 0.0, 0.0),
    noise=0.0,
)


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """Rotation of the base in map (3, 3), and twist and curvatures (N, 3) [1/m] of the N arcs."""

    R_map_base: np.ndarray
    strain: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Postures with the time [s] spent in each and on the way to it (the first needs no way)."""

    postures: Sequence[Posture]
    hold: Sequence[float]
    travel: Sequence[float]

    @property
    def arrivals(self) -> np.ndarray:
        """(N,) times at which each posture is reached."""
        return np.cumsum(np.asarray(self.travel)) + np.concatenate(
            [[0.0], np.cumsum(self.hold)[:-1]]
        )

    @property
    def departures(self) -> np.ndarray:
        """(N,) times at which each posture is left."""
        return self.arrivals + np.asarray(self.hold)

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_map_base (K, 3, 3) and strain (K, N, 3) at times (K,), smooth in acceleration."""
        arrivals, departures = self.arrivals, self.departures
        knots = np.sort(np.concatenate([arrivals, departures]))
        index = np.clip(np.searchsorted(knots, times, side='right') - 1, 0, len(knots) - 2)
        span = np.maximum(knots[index + 1] - knots[index], 1e-12)
        u = np.clip((times - knots[index]) / span, 0.0, 1.0)
        # Quintic smoothstep between knots; a hold's two knots are the same posture.
        progress = index + u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
        which = np.arange(len(self.postures)).repeat(2)
        rotations = Rotation.from_matrix(np.stack([self.postures[i].R_map_base for i in which]))
        strains = np.stack([self.postures[i].strain for i in which])
        progress = np.clip(progress, 0.0, len(which) - 1.0)
        low = np.minimum(progress.astype(int), len(which) - 2)
        share = (progress - low)[:, None, None]
        strain = strains[low] + share * (strains[low + 1] - strains[low])
        return Slerp(np.arange(len(which)), rotations)(progress).as_matrix(), strain


def bent(robot: RobotDescription, curvature: float, azimuth: float = 0.0) -> np.ndarray:
    """(N, 3) strain of a bend by `curvature` [1/m] from x towards y turned by `azimuth`."""
    return profile(robot, lambda s: (np.full_like(s, curvature), np.full_like(s, azimuth)))


def s_shape(
    robot: RobotDescription, curvature: float, azimuth: float = 0.0, halves: float = 1.0
) -> np.ndarray:
    """
    (N, 3) strain of an S.

    Its curvature passes smoothly from `curvature` [1/m] at the base to its opposite `halves`
    times; from 2 on its tangent turns across the magnet's axis.
    """
    return profile(
        robot,
        lambda s: (
            curvature * np.cos(halves * np.pi * s / robot.length),
            np.full_like(s, azimuth),
        ),
    )


def out_of_plane(robot: RobotDescription, curvature: float, turn: float = np.pi / 2) -> np.ndarray:
    """(N, 3) strain of `curvature` [1/m]; its bending plane turns by `turn` [rad] in all."""
    return profile(robot, lambda s: (np.full_like(s, curvature), turn * s / robot.length))


def profile(
    robot: RobotDescription, bend: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """(N, 3) strain without twist; `bend` gives curvature and azimuth at s (N,)."""
    ends = piece_ends(robot)
    curvature, azimuth = bend(ends - 0.5 * np.diff(ends, prepend=0.0))
    return np.column_stack(
        [np.zeros_like(ends), -curvature * np.sin(azimuth), curvature * np.cos(azimuth)]
    )


def piece_ends(robot: RobotDescription) -> np.ndarray:
    """(N,) arclengths [m] of the arcs' ends; each `PIECES`-th is a module, the last the tip."""
    marks = np.array(
        [0.0, *(robot.sensor_arclength(sensor.name) for sensor in robot.hall), robot.length]
    )
    shares = np.arange(1, PIECES + 1) / PIECES
    return (marks[:-1, None] + np.diff(marks)[:, None] * shares).ravel()


class Arm:
    """One simulated arm, its imperfections drawn from `seed`."""

    def __init__(
        self, robot: RobotDescription, imperfections: Imperfections | None = None, seed: int = 0
    ) -> None:
        self.robot, self.imperfections = robot, imperfections or Imperfections()
        self.rng = np.random.default_rng(seed)
        truth, modules = self.imperfections, len(robot.hall)
        imu, hall = module_mounts(robot)
        self.R_module_imu = imu @ self._askew(modules)
        self.R_module_hall = hall @ self._askew(modules)
        self.gyro_bias = (
            truth.noise * robot.imu_model.gyro_bias_sigma * self.rng.standard_normal((modules, 3))
        )
        self.accel_offset = truth.accel_offset * self.rng.standard_normal((modules, 3))
        self.hall_offset = truth.hall_offset * self.rng.standard_normal((modules, 3))
        remanence = robot.magnet.remanence * (1.0 + truth.moment * self.rng.standard_normal())
        self.magnet = robot.magnet.model_copy(update={'remanence': remanence})
        self.ends = piece_ends(robot)
        self.lengths = np.diff(self.ends, prepend=0.0)

    def _askew(self, count: int) -> np.ndarray:
        axis = self.rng.standard_normal((count, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return lie.so3_exp(np.radians(self.imperfections.mounting_deg) * axis)

    def posture(
        self, strain: np.ndarray | None = None, R_base: np.ndarray | None = None
    ) -> Posture:
        """Make a posture with the base turned by `R_base` (3, 3) in map from the description's."""
        turn = np.eye(3) if R_base is None else R_base
        return Posture(
            turn @ self.robot.base.T_map_base[:3, :3],
            bent(self.robot, 0.0) if strain is None else strain,
        )

    def T_base_module(self, strain: np.ndarray) -> np.ndarray:
        """(..., M, 4, 4) poses of the modules in the base frame, strain (..., N, 3)."""
        first = PIECES - 1
        return self._chain(strain)[..., first:-1:PIECES, :, :]

    def _chain(self, strain: np.ndarray) -> np.ndarray:
        """(..., N, 4, 4) poses of the ends of all arcs."""
        unit = np.broadcast_to([1.0, 0.0, 0.0], strain.shape)
        T = lie.exp(self.lengths[:, None] * np.concatenate([unit, strain], axis=-1))
        for n in range(1, strain.shape[-2]):
            T[..., n, :, :] = T[..., n - 1, :, :] @ T[..., n, :, :]
        return T

    def backbone(self, strain: np.ndarray, s: np.ndarray) -> np.ndarray:
        """(S, 3) true positions in the base frame at arclengths s (S,) [m]."""
        piece = np.minimum(np.searchsorted(self.ends, s), len(self.ends) - 1)
        start = np.concatenate([np.eye(4)[None], self._chain(strain)[:-1]])
        within = s - np.concatenate([[0.0], self.ends[:-1]])[piece]
        step = lie.exp(
            within[:, None] * np.hstack([np.tile([1.0, 0.0, 0.0], (len(s), 1)), strain[piece]])
        )
        return (start[piece] @ step)[:, :3, 3]

    def record(
        self, motion: Motion, start_stamp: int = NANOSECONDS
    ) -> list[ImuSample | FieldSample]:
        """All samples of the motion in stamp order; the motion begins at `start_stamp`."""
        end = motion.departures[-1]
        samples: list[ImuSample | FieldSample] = []
        for m in range(len(self.robot.hall)):
            # Modules are read one after the other on the bus.
            imu_times = np.arange(0.0031 * m, end, 1.0 / self.robot.imu_model.rate)
            hall_times = np.arange(0.0031 * m + 0.001, end, 1.0 / self.robot.hall_model.rate)
            samples += self._imu(m, motion, imu_times, start_stamp)
            samples += self._hall(m, motion, hall_times, start_stamp)
        return sorted(samples, key=lambda sample: sample.stamp)

    def _poses(self, m: int, motion: Motion, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_map_base (K, 3, 3) and T_base_module (K, 4, 4) of module m."""
        R_map_base, strain = motion.at(times)
        return R_map_base, self.T_base_module(strain)[:, m]

    def _imu(self, m: int, motion: Motion, times: np.ndarray, start: int) -> Iterator[ImuSample]:
        model, noise, h = self.robot.imu_model, self.imperfections.noise, 1e-3
        R, p = [], []
        for shift in (-h, 0.0, h):  # central differences of exact poses
            R_map_base, T_base_module = self._poses(m, motion, times + shift)
            R.append(R_map_base @ T_base_module[:, :3, :3])
            p.append(np.einsum('kij,kj->ki', R_map_base, T_base_module[:, :3, 3]))
        R_map_imu = R[1] @ self.R_module_imu[m]
        rate = lie.so3_log(R[0].swapaxes(1, 2) @ R[2]) / (2.0 * h) @ self.R_module_imu[m]
        force = (p[0] - 2.0 * p[1] + p[2]) / h**2 + [0.0, 0.0, GRAVITY]
        shape = rate.shape
        gyro = (
            rate + self.gyro_bias[m] + noise * model.gyro_sigma * self.rng.standard_normal(shape)
        )
        accel = np.einsum('kji,kj->ki', R_map_imu, force) + self.accel_offset[m]
        accel += noise * model.accel_sigma * self.rng.standard_normal(shape)
        gyro, accel = (
            np.clip(a, -full, full)
            for a, full in ((gyro, model.gyro_range), (accel, model.accel_range))
        )
        name, stamps = self.robot.imu[m].name, stamps_of(times, start)
        return (
            ImuSample(stamp, name, g, a) for stamp, g, a in zip(stamps, gyro, accel, strict=True)
        )

    def _hall(
        self, m: int, motion: Motion, times: np.ndarray, start: int
    ) -> Iterator[FieldSample]:
        model = self.robot.hall_model
        R_map_base, T = self._poses(m, motion, times)
        source = ring_field(self.magnet, T[:, :3, 3] - [self.robot.magnet.s, 0.0, 0.0])
        in_base = source + np.einsum('kji,j->ki', R_map_base, self.imperfections.earth_field)
        field = (
            np.einsum('kji,kj->ki', T[:, :3, :3] @ self.R_module_hall[m], in_base)
            + self.hall_offset[m]
        )
        field += self.imperfections.noise * model.sigma * self.rng.standard_normal(field.shape)
        lsb = np.asarray(model.lsb)
        read = np.where(np.abs(field) <= model.saturation, np.round(field / lsb) * lsb, np.nan)
        name, stamps = self.robot.hall[m].name, stamps_of(times, start)
        return (FieldSample(stamp, name, b) for stamp, b in zip(stamps, read, strict=True))

    def calibration_rests(self, seconds: float = 2.0) -> list[PosedRest]:
        """
        Rests of the straight arm, the base turned through `CALIBRATION_TURNS`.

        It is turned by an arm that is off by `base_pose_deg`; the poses told are the commanded
        ones.
        """
        rests = []
        for turn in CALIBRATION_TURNS:
            R_told = (
                self.robot.base.T_map_base[:3, :3]
                @ Rotation.from_euler('xyz', turn, degrees=True).as_matrix()
            )
            off = np.radians(self.imperfections.base_pose_deg) * self.rng.standard_normal(3)
            true = Posture(R_told @ lie.so3_exp(off), bent(self.robot, 0.0))
            rests.append(self._rest(true, R_told, seconds))
        return rests

    def taring_rest(self, seconds: float = 2.0) -> PosedRest:
        """One rest of the straight arm with the base as the robot description has it."""
        posture = self.posture()
        return self._rest(posture, posture.R_map_base, seconds)

    def _rest(self, posture: Posture, R_told: np.ndarray, seconds: float) -> PosedRest:
        window = RestWindow(self.robot)
        for sample in self.record(Motion([posture], [seconds], [0.0])):
            window.add(sample)
        T_map_base = np.eye(4)
        T_map_base[:3, :3] = R_told
        return PosedRest(window.finish(), T_map_base, straight_modules(self.robot))


def stamps_of(times: np.ndarray, start: int) -> list[int]:
    """Integer stamps [ns] of times (K,) [s] from `start`."""
    return [start + nanoseconds(time) for time in times]


# Turns of the base about its own axes (deg): upright, over to four sides, upside down, and about
# the tangent.
CALIBRATION_TURNS = (
    (0, 0, 0),
    (0, 80, 0),
    (0, -80, 0),
    (0, 0, 80),
    (0, 0, -80),
    (0, 150, 0),
    (90, 60, 0),
    (180, 0, 60),
    (-90, -60, 0),
    (180, 0, 0),
)


def groove_motion(
    arm: Arm, strain: np.ndarray, rest: float = 2.0, travel: float = 2.0, hold: float = 2.0
) -> Motion:
    """Rest straight and upright, then into the groove, and stay there."""
    return Motion([arm.posture(), arm.posture(strain)], [rest, hold], [0.0, travel])
