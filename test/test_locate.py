"""A start from nothing: found where the place is unlike all others, and not told elsewhere."""

from dataclasses import replace

from continuum_loc import lie
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.mapping.distances import DistanceField, FAR
from continuum_loc.measurements import ImuSample, nanoseconds, TruthSample
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import EPOCH, Rod, rod, ROOM, room_map, stream

MIDDLE = ROOM.mean(axis=0)


@pytest.fixture(scope='module')
def prior_map():
    return room_map(0.05)


def free_rod(guess: np.ndarray, region: tuple[float, float]) -> RobotDescription:
    """Describe the rod with a base that begins somewhere about `guess` (4, 4)."""
    data = rod().model_dump()
    rpy = Rotation.from_matrix(guess[:3, :3]).as_euler('xyz', degrees=True)
    data['base'] |= {
        'mode': 'free',
        'region': region,
        'xyz': tuple(guess[:3, 3].tolist()),
        'rpy_deg': tuple(rpy.tolist()),
    }
    return parse_settings(RobotDescription, data)


def upright(world: Rod, duration: float):
    """Yield the rod's samples, with accelerometers that feel gravity."""
    for sample in stream(world, duration):
        if isinstance(sample, ImuSample):
            ring = 1 + ('r1_imu', 'r2_imu').index(sample.sensor)
            T = world.rings((sample.stamp - EPOCH) / 1e9)[ring]
            sample = replace(sample, linear_acceleration=T[:3, :3].T @ [0.0, 0.0, 9.81])
        yield sample


def run(robot: RobotDescription, samples, prior_map):
    """Filter, estimates, and the largest error [m] of a ring in each."""
    filter_ = SlidingWindowFilter(robot, prior_map)
    truth, estimates = {}, []
    for sample in samples:
        if isinstance(sample, TruthSample):
            truth[sample.stamp] = sample.T_map_ring
        elif estimate := filter_.process(sample):
            estimates.append(estimate)
    off = [
        np.linalg.norm((one.T_map_ring - truth[one.stamp])[:, :3, 3], axis=1).max()
        for one in estimates
    ]
    return filter_, estimates, np.array(off)


def guess_off(shift: tuple[float, float, float], turn_deg: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = lie.so3_exp(np.radians([0.3 * turn_deg, 0.0, turn_deg]))
    T[:3, 3] = shift
    return T


def test_distances_are_those_to_the_nearest_wall(prior_map):
    field = DistanceField.of(prior_map)
    assert field.voxel == 0.025
    for depth in (0.03, 0.1, 0.2, 0.4):
        place = np.array([ROOM[0, 0] + depth, *MIDDLE[1:]])
        found = field.distance[tuple(((place - field.origin) / field.voxel).astype(int))]
        assert found == pytest.approx(min(depth, FAR), abs=0.05)


def test_a_base_is_found_in_its_region_and_nothing_is_told_before(prior_map):
    """The guess is 30 cm and 15 deg off; the room is unlike itself within 40 cm and 25 deg."""
    robot = free_rod(guess_off((0.2, -0.15, 0.15), 15.0), (0.4, 25.0))
    filter_, estimates, off = run(robot, upright(Rod(robot), 2.5), prior_map)
    assert estimates[0].stamp > EPOCH + nanoseconds(0.5)  # searched, tried and confirmed
    assert off.max() < 0.006 and {one.status for one in estimates} == {'tracking'}
    assert not filter_.start.pending and len(filter_.start.hypotheses) == 0


def test_a_place_that_looks_the_same_from_two_sides_is_not_told(prior_map):
    """A box is the same after half a turn about its middle: two places fit, and none is chosen."""
    robot = free_rod(np.eye(4), (5.0, 180.0))
    filter_, estimates, _ = run(robot, upright(Rod(robot), 1.6), prior_map)
    assert not estimates and filter_.start.pending
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    half_turn[:2, 3] = 2.0 * MIDDLE[:2]
    places = filter_.start.hypotheses
    for wanted in (np.eye(4), half_turn):
        gaps = lie.log(lie.inverse(wanted) @ places)
        assert np.linalg.norm(gaps[:, :3], axis=1).min() < 0.02


def test_a_kidnapped_robot_says_so_and_is_found(prior_map):
    """Carried off by 25 cm and 10 deg between two samples."""
    moved = lie.exp(np.array([0.15, 0.2, 0.0, 0.0, 0.0, np.radians(10.0)]))

    class Kidnapped(Rod):
        def poses(self, time, s):
            T = super().poses(time, s)
            return moved @ T if time > 1.6 else T

        def rates(self, time):
            return super().rates(time if abs(time - 1.6) > 1e-3 else time + 2e-3)

    robot = free_rod(np.eye(4), (0.4, 25.0))
    _, estimates, off = run(robot, upright(Kidnapped(robot), 3.6), prior_map)
    lost = [one.stamp for one in estimates if one.status == 'lost']
    assert EPOCH + nanoseconds(1.6) < lost[0] < EPOCH + nanoseconds(2.1)
    after = [k for k, one in enumerate(estimates) if one.stamp > lost[-1]]
    assert len(after) > 5 and off[after].max() < 0.006
    assert {estimates[k].status for k in after} == {'tracking'}


def test_a_base_of_which_the_place_is_known_is_not_searched_for(prior_map):
    robot = free_rod(np.eye(4), (0.0, 0.0))
    filter_ = SlidingWindowFilter(robot, prior_map, EstimatorSettings())
    assert not filter_.start.wanted and not filter_.start.pending
