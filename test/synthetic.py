"""
A body that bends and is inserted along a known path.

Samples of it, and an estimator with known errors.
"""

from continuum_loc import lie
from continuum_loc.estimate import Estimate
from continuum_loc.measurements import ImuSample, NANOSECONDS, TOF_VALID, TofFrame, TruthSample
from continuum_loc.robot import load_robot, RobotDescription
import numpy as np

START = 1_000_000_000


def poses_at(robot: RobotDescription, arclengths: np.ndarray, time: float) -> np.ndarray:
    """(N, 4, 4) poses of a constant-curvature body that is pushed in and swings."""
    strain = np.array([1.0, 0, 0, 0, 0.6 * np.sin(0.8 * time), 0.9 * np.sin(0.5 * time + 0.5)])
    insertion = lie.exp(np.array([0.04 * time, 0, 0, 0, 0, 0]))
    return robot.base.T_map_base @ insertion @ lie.exp(np.asarray(arclengths)[:, None] * strain)


def truth_at(robot: RobotDescription, stamp: int) -> np.ndarray:
    """(R + 1, 4, 4) true poses of base and rings."""
    return poses_at(
        robot, np.concatenate([[0.0], robot.ring_arclengths]), (stamp - START) / NANOSECONDS
    )


def samples(robot: RobotDescription, duration: float, seed: int = 0):
    """Truth and gyros at 100 Hz and one ToF frame per sensor at 10 Hz, in stamp order."""
    rng = np.random.default_rng(seed)
    for tick in range(round(duration * 100)):
        stamp = START + tick * NANOSECONDS // 100
        yield TruthSample(stamp, truth_at(robot, stamp))
        for sensor in robot.imu:
            yield ImuSample(stamp, sensor.name, rng.normal(size=3), np.array([0.0, 0.0, 9.81]))
        if tick % 10 == 0:
            yield from (frame(robot, sensor.name, stamp, rng) for sensor in robot.tof)


def frame(robot: RobotDescription, name: str, stamp: int, rng: np.random.Generator) -> TofFrame:
    """Draw a frame of random ranges, one zone in ten without return."""
    ranges = rng.uniform(0.2, 0.6, len(robot.tof_model.directions))
    status = np.where(rng.random(len(ranges)) < 0.1, 255, TOF_VALID).astype(np.uint8)
    return TofFrame(
        stamp,
        name,
        robot.tof_model.directions * ranges[:, None],
        ranges,
        robot.tof_model.sigma(ranges),
        status,
    )


class NoisyFilter:
    """Answers each cycle of ToF frames with true poses plus errors of the covariance it states."""

    def __init__(
        self, robot: RobotDescription | None = None, sigma: float = 0.002, seed: int = 0
    ) -> None:
        self.robot = robot or load_robot('engine')
        self.sigma = sigma
        self.counts = {
            'received': {'tof': 0, 'imu': 0},
            'used': {'tof': 0, 'imu': 0},
            'dropped': {},
        }
        self._rng = np.random.default_rng(seed)

    def process(self, measurement):
        kind = 'tof' if isinstance(measurement, TofFrame) else 'imu'
        self.counts['received'][kind] += 1
        self.counts['used'][kind] += 1
        last = kind == 'tof' and measurement.sensor == self.robot.tof[-1].name
        return self._estimate(measurement.stamp) if last else None

    def flush(self):
        return None

    def reset(self):
        """Nothing of the past is kept."""

    def _estimate(self, stamp: int, lagged: bool = True) -> Estimate:
        true = truth_at(self.robot, stamp)
        growth = (
            np.linspace(0.3, 1.0, len(true))[:, None] * self.sigma * np.array([1, 1, 1, 4, 4, 4])
        )
        s = np.linspace(0.0, self.robot.length, 51)
        earlier = stamp - NANOSECONDS // 5
        return Estimate(
            stamp=stamp,
            T_map_ring=true @ lie.exp(-growth * self._rng.normal(size=growth.shape)),
            covariance=np.einsum('rk,kl->rkl', growth**2, np.eye(6)),
            strain=np.zeros((len(true), 6)),
            velocity=np.zeros((len(true), 6)),
            velocity_covariance=np.tile(np.eye(6), (len(true), 1, 1)),
            backbone_s=s,
            T_map_backbone=poses_at(self.robot, s, (stamp - START) / NANOSECONDS),
            status='initialising' if stamp < START + NANOSECONDS // 2 else 'tracking',
            consistency=1.0,
            lagged=self._estimate(earlier, lagged=False) if lagged and earlier > START else None,
        )
