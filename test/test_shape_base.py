"""The shape of an arm whose base is carried: what is told of the base is taken out of it."""

from heapq import merge

from continuum_loc import lie
from continuum_loc.measurements import BaseSample, EncoderSample, NANOSECONDS, nanoseconds
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.settings import parse_settings
from continuum_loc.shape import ShapeEstimator
from continuum_loc.shape.base_motion import BaseMotion
from continuum_loc.shape.calibration import calibrate
from continuum_loc.simulator.hall_arm import Arm, bent, Motion, PERFECT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SECOND = NANOSECONDS


def carried(**base) -> RobotDescription:
    data = load_robot('hall_arm').model_dump()
    data['base'] |= {'mode': 'measured', **base}
    return parse_settings(RobotDescription, data)


def stamp_of(sample) -> int:
    return sample.stamp


def turned_arm(robot: RobotDescription):
    """Make an arm that bends by 10 1/m, whose base is turned by 70 deg, and what is told."""
    arm = Arm(robot, PERFECT.model_copy(update={'earth_field': (20e-6, 3e-6, -43e-6)}))
    over = Rotation.from_euler('xyz', [10, 60, 30], degrees=True).as_matrix()
    strain = bent(robot, 10.0, 0.5)
    postures = [arm.posture(), arm.posture(strain), arm.posture(strain, over)]
    motion = Motion(postures, [1.5, 0.5, 1.0], [0.0, 1.0, 1.5])
    times = np.arange(0.0, 5.5, 0.01)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, :3] = motion.at(times)[0]
    told = [
        BaseSample(SECOND + nanoseconds(time), 'map', pose)
        for time, pose in zip(times, T, strict=True)
    ]
    return arm, arm.record(motion), told, strain, T[-1]


def last_of(estimator: ShapeEstimator, samples):
    made = [estimator.process(sample) for sample in samples]
    return next(one for one in reversed(made) if one is not None)


def test_an_arm_keeps_its_shape_while_its_base_turns():
    robot = carried()
    arm, samples, told, strain, T_map_base = turned_arm(robot)
    calibration = calibrate(robot, arm.calibration_rests())  # which tells the Earth's field
    estimator = ShapeEstimator(robot, calibration=calibration)
    estimate = last_of(estimator, merge(told, samples, key=stamp_of))
    np.testing.assert_allclose(estimate.T_map_base, T_map_base, atol=1e-6)
    off = lie.inverse(T_map_base @ arm.T_base_module(strain)) @ estimate.T_map_module
    assert np.abs(off[:, :3, 3]).max() < 2e-4
    assert np.degrees(np.abs(lie.log(off)[:, 3:])).max() < 0.2
    # With the description's constant base the turn of 70 deg is taken for one of the modules.
    fixed = ShapeEstimator(load_robot('hall_arm'), calibration=calibration)
    constant = last_of(fixed, samples)
    assert np.abs(constant.T_map_module - estimate.T_map_module)[:, :3, 3].max() > 0.01


def test_nothing_is_estimated_before_the_base_is_told():
    robot = carried()
    _, samples, _, _, _ = turned_arm(robot)
    estimator = ShapeEstimator(robot)
    assert all(estimator.process(sample) is None for sample in samples)
    assert estimator.message == 'nobody has told where the base is'


def test_the_base_is_asked_for_between_its_samples_and_a_little_ahead():
    motion = BaseMotion(carried(measurement={'latency': 0.02}))
    turn = np.array([0.0, 0, 0, 0, 0, 1.0])
    for k in range(4):  # one radian per second; told 20 ms late
        motion.take(BaseSample(nanoseconds(0.1 * k + 0.02), 'map', lie.exp(0.1 * k * turn)))
    for time in (0.05, 0.1, 0.27, 0.33):
        np.testing.assert_allclose(
            motion.rotation(nanoseconds(time)), lie.exp(time * turn)[:3, :3], atol=1e-6
        )
    held = motion.rotation(nanoseconds(5.0))  # not farther than 50 ms ahead
    np.testing.assert_allclose(held, lie.exp(0.35 * turn)[:3, :3], atol=1e-6)


@pytest.mark.parametrize('speed, moves', [(0.0, False), (0.05, True)])
def test_a_base_that_is_carried_moves(speed, moves):
    motion = BaseMotion(carried())
    for k in range(30):
        motion.take(
            BaseSample(k * SECOND // 100, 'map', lie.exp(np.array([speed * k / 100] + [0] * 5)))
        )
    assert motion.moves(29 * SECOND // 100) == moves


def test_the_magnet_goes_with_an_inserted_base():
    insertion = {'mode': 'measured', 'range': [0.0, 0.2]}
    motion = BaseMotion(carried(mode='fixed', insertion=insertion))
    motion.take(EncoderSample(1, ('tendon1', 'insertion'), np.array([0.0, 0.1]), np.zeros(2)))
    robot = load_robot('hall_arm')
    # Its x stands up.
    np.testing.assert_allclose(motion.pose(2)[:3, 3], [0.0, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(motion.rotation(2), robot.base.T_map_base[:3, :3])
