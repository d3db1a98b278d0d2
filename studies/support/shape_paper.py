"""
The paper's own pipeline, as printed, for comparison: what each of its errors costs.

`MENDS` names the steps from print to this package's pipeline. `paper_pipeline` applies those asked
for and takes the printed form of all others. The optimum of eq. 10 is found with this package's
solver: it is the same problem as the paper's `fmincon` call.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from continuum_loc.errors import StudyError
from continuum_loc.magnet import dipole_moment
from continuum_loc.measurements import FieldSample, ImuSample
from continuum_loc.robot import RobotDescription
from continuum_loc.shape.attitude import GRAVITY
from continuum_loc.shape.calibration import module_mounts
from continuum_loc.shape.curves import CurveMethod
from continuum_loc.shape.position import PositionSolver
from continuum_loc.shape.rest import Rest
import numpy as np
from studies.support.euler_filter import EulerFilter
from studies.support.shape_curves import fit_projected, printed_quadratic_bezier

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
        """Subtract what should read: +g along the IMU's z, and no field without the magnet."""
        return cls(rest.gyro, rest.accel - [0.0, 0.0, GRAVITY], rest_without_magnet.field)


@dataclass(frozen=True, slots=True, eq=False)
class PaperEstimate:
    """Points (M + 1, 3) [m] and tangents (M + 1, 3) of magnet and modules in the base frame."""

    points: np.ndarray
    tangents: np.ndarray
    mends: frozenset[str]

    def curve(self, method: CurveMethod, samples: int = 61) -> np.ndarray:
        """Draw (samples, 3) points of the projected curve, with kappa as printed unless mended."""
        if method == 'quadratic_bezier' and 'kappa' not in self.mends:
            return printed_quadratic_bezier(self.points, self.tangents, samples)
        return fit_projected(self.points, self.tangents, method, samples)


def paper_pipeline(
    robot: RobotDescription,
    samples: Sequence[ImuSample | FieldSample],
    background: Background,
    mends: Iterable[str] = (),
) -> PaperEstimate:
    """Eqs. 1-10 over a recording of an upright robot. Raises StudyError for an unknown mend."""
    mends = frozenset(mends)
    if mends - set(MENDS):
        raise StudyError(f'unknown mends {sorted(mends - set(MENDS))}; valid: {", ".join(MENDS)}')
    imu_mount, hall_mount = module_mounts(robot)
    R_imu_hall = imu_mount.swapaxes(1, 2) @ hall_mount  # eq. 8
    R_world_imu, field = _last_readings(robot, samples, background, mends)
    field_world = np.einsum('mij,mj->mi', R_world_imu @ R_imu_hall, field)  # eq. 9
    # The paper's world has the straight modules' axes; the base has its x along their z.
    field_base = np.einsum('mij,mj->mi', imu_mount, field_world)
    tangents = np.einsum('mij,mj->mi', imu_mount, R_world_imu[:, :, 2])
    s = np.array([robot.sensor_arclength(sensor.name) for sensor in robot.hall])
    strength = PAPER_MOMENT / abs(dipole_moment(robot.magnet))
    magnet = robot.magnet.model_copy(update={'remanence': strength * robot.magnet.remanence})
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
