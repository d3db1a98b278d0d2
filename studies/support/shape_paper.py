"""
The paper's own pipeline, as printed, for comparison: what each of its errors costs.

`MENDS` names the steps from print to this package's pipeline. `paper_pipeline` applies those asked
for and takes the printed form of all others. The optimum of eq. 10 is found with this package's
solver: it is the same problem as the paper's `fmincon` call.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from continuum_loc.magnet import with_moment
from continuum_loc.measurements import FieldSample, ImuSample
from continuum_loc.robot import RobotDescription
from continuum_loc.shape import curves
from continuum_loc.shape.attitude import EulerFilter, GRAVITY
from continuum_loc.shape.calibration import module_mounts
from continuum_loc.shape.position import PositionSolver
from continuum_loc.shape.rest import Rest
import numpy as np

PAPER_MOMENT = 0.836  # A m^2

MENDS = {
    'swap': 'eq. 6: roll and pitch swapped back',
    'pitch': 'eq. 3: sign of the pitch',
    'quadrant': 'eq. 3: atan2 for the roll',
    'yaw': 'eq. 5: yaw carried by the gyro, not pulled to 0',
    'kappa': 'eq. 14: sign of kappa (quadratic Bezier)',
    'ring': 'eq. 2: ring magnet for the dipole',
}


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """
    What the paper clears before the experiment, (M, 3) each in the sensors' frames.

    Gyro and accelerometer of the straight, upright robot at rest, and the Hall sensors' readings
    without the magnet.
    """

    gyro: np.ndarray
    accel: np.ndarray
    field: np.ndarray

    @classmethod
    def of(cls, rest: Rest, rest_without_magnet: Rest) -> Background:
        """
        From a rest with the magnet and one without it.

        What the IMU should read is +g along its z.
        """
        return cls(rest.gyro, rest.accel - [0.0, 0.0, GRAVITY], rest_without_magnet.field)


@dataclass(frozen=True, slots=True, eq=False)
class PaperEstimate:
    """
    Points (M + 1, 3) [m] and tangents (M + 1, 3) of magnet and modules, at the last sample.

    In the base frame.
    """

    points: np.ndarray
    tangents: np.ndarray
    mends: frozenset[str]

    def curve(self, method: curves.CurveMethod, samples: int = 61) -> np.ndarray:
        """
        Draw (samples, 3) points of the projected curve.

        The quadratic one has the printed sign of kappa unless mended.
        """
        if method == 'quadratic_bezier' and 'kappa' not in self.mends:
            return printed_quadratic_bezier(self.points, self.tangents, samples)
        return curves.fit_curve(
            self.points, self.tangents, method, projected=True, samples=samples
        )


def paper_pipeline(
    robot: RobotDescription,
    samples: Sequence[ImuSample | FieldSample],
    background: Background,
    mends: Iterable[str] = (),
) -> PaperEstimate:
    """
    Eqs. 1-10 over a recording of an upright robot.

    Raises ValueError for a mend that does not exist.
    """
    mends = frozenset(mends)
    if mends - set(MENDS):
        raise ValueError(f'unknown mends {sorted(mends - set(MENDS))}; valid: {", ".join(MENDS)}')
    imu_mount, hall_mount = module_mounts(robot)
    R_imu_hall = imu_mount.swapaxes(1, 2) @ hall_mount  # eq. 8
    R_world_imu, field = _last_readings(robot, samples, background, mends)
    field_world = np.einsum('mij,mj->mi', R_world_imu @ R_imu_hall, field)  # eq. 9
    # The paper's world has the straight modules' axes; the base has its x along their z.
    field_base = np.einsum('mij,mj->mi', imu_mount, field_world)
    tangents = np.einsum('mij,mj->mi', imu_mount, R_world_imu[:, :, 2])
    s = np.array([robot.sensor_arclength(sensor.name) for sensor in robot.hall])
    magnet = with_moment(robot.magnet, np.sign(robot.magnet.remanence) * PAPER_MOMENT)
    positions = (
        PositionSolver(magnet, s, 'ring' if 'ring' in mends else 'dipole')
        .solve(field_base)
        .position
    )
    return PaperEstimate(
        np.vstack([np.zeros(3), positions]), np.vstack([[1.0, 0.0, 0.0], tangents]), mends
    )


def _last_readings(
    robot: RobotDescription,
    samples: Sequence[ImuSample | FieldSample],
    background: Background,
    mends: frozenset[str],
) -> tuple[np.ndarray, np.ndarray]:
    """R_world_imu (M, 3, 3) by the paper's filter after all samples; the last fields (M, 3)."""
    filters = [
        EulerFilter(
            swap_as_printed='swap' not in mends,
            pitch_as_printed='pitch' not in mends,
            quadrant_as_printed='quadrant' not in mends,
            yaw_as_printed='yaw' not in mends,
        )
        for _ in robot.imu
    ]
    imu, hall = (
        {sensor.name: m for m, sensor in enumerate(sensors)} for sensors in (robot.imu, robot.hall)
    )
    field = np.full((len(hall), 3), np.nan)
    for sample in samples:
        if isinstance(sample, ImuSample):
            m = imu[sample.sensor]
            filters[m].update(
                sample.stamp,
                sample.angular_velocity - background.gyro[m],
                sample.linear_acceleration - background.accel[m],
            )
        else:
            field[hall[sample.sensor]] = sample.field - background.field[hall[sample.sensor]]
    return np.stack([f.R_map_imu for f in filters]), field


def printed_quadratic_bezier(points: np.ndarray, tangents: np.ndarray, samples: int) -> np.ndarray:
    """
    Eqs. 12-14 and 23-24 with kappa exactly as printed.

    Not finite where neighbouring tangents are parallel.
    """
    p, n = curves.project(points), curves.project(tangents)
    chord = np.diff(p, axis=0)
    with np.errstate(divide='ignore', invalid='ignore'):
        kappa = curves.cross(n[1:], chord) / curves.cross(n[:-1], n[1:])
        control = p[:-1] + kappa[:, None] * n[:-1]
        return curves.lift(curves.quadratic_chain(p[:-1], control, p[1:], samples), points)
