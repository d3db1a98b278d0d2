"""A base that is carried, in the simulator: where it goes, and what is told of it."""

from continuum_loc import lie
from continuum_loc.errors import SettingsError
from continuum_loc.measurements import BaseSample, EncoderSample, NANOSECONDS, TruthSample
from continuum_loc.offline.trials import Trial, with_base
from continuum_loc.offline.trials import world as make_world
from continuum_loc.robot import load_robot
from continuum_loc.simulator.carrier import BaseTeller, Carrier, carrier, pose_of, Told
from continuum_loc.simulator.plant import load_plant
from continuum_loc.simulator.trajectories import levelled, trajectory
from continuum_loc.simulator.world import World
import numpy as np
import pytest

EXACT = Told(
    error_position=0.0, error_rotation_deg=0.0, noise_position=0.0, noise_rotation_deg=0.0
)
RATE = 20.0


def told_of(told: Told, poses: np.ndarray, seed: int = 0) -> np.ndarray:
    """Poses (K, 4, 4) that a carrier tells of true ones, sample by sample."""
    teller = BaseTeller(told, 'map', RATE, np.random.default_rng(seed))
    return np.array([teller.measure(k, k / RATE, T)[0].T_frame_base for k, T in enumerate(poses)])


def straight_way(speed: float, seconds: float) -> np.ndarray:
    T = np.tile(np.eye(4), (round(seconds * RATE), 1, 1))
    T[:, 0, 3] = speed * np.arange(len(T)) / RATE
    return T


def test_the_drives_are_slides_then_yaw_pitch_and_roll():
    values = np.array([0.1, 0.2, 0.3, np.pi / 2, 0.0, np.pi / 2])
    # Yaw takes x to y; a roll about that y then takes the base's own y, which was -x, to z.
    np.testing.assert_allclose(
        pose_of(values), [[0, 0, 1, 0.1], [1, 0, 0, 0.2], [0, 1, 0, 0.3], [0, 0, 0, 1]], atol=1e-12
    )


def test_late_stamps_tell_of_where_the_base_was():
    late = told_of(EXACT.model_copy(update={'latency': 0.025}), straight_way(0.4, 1.0))
    np.testing.assert_allclose(late[5:, 0, 3], 0.4 * (np.arange(5, 20) / RATE - 0.025))


def test_an_error_of_kinematics_has_its_size_and_lasts():
    told = EXACT.model_copy(update={'error_position': 0.001, 'lasting': 2.0})
    errors = np.array(
        [told_of(told, np.tile(np.eye(4), (21, 1, 1)), seed)[:, :3, 3] for seed in range(150)]
    )
    # 450 values: their spread is known to 3 %; half a lasting time keeps exp(-1/2) of an error.
    assert np.std(errors[:, -1]) == pytest.approx(0.001, rel=0.1)
    kept = np.mean(errors[:, 0] * errors[:, 20]) / np.mean(errors[:, 0] ** 2)
    assert kept == pytest.approx(np.exp(-0.5), abs=0.15)


def test_odometry_drifts_by_a_share_of_its_way_and_not_at_rest():
    told = Told(drift=0.05, noise_position=0.0, noise_rotation_deg=0.0)
    way = straight_way(0.5, 1.0)
    moved = [told_of(told, way, seed)[-1, 0, 3] - way[-1, 0, 3] for seed in range(100)]
    # One second of way, over which the drift stays nearly the same: 5 % of 0.475 m.
    assert np.std(moved) == pytest.approx(0.05 * 0.475, rel=0.25)
    rested = told_of(told, np.tile(np.eye(4), (100, 1, 1)))
    assert np.abs(rested[-1, :3, 3]).max() < 1e-4


def test_a_rolled_base_pulls_so_that_the_moments_stay_in_the_map():
    """By a quarter turn about x what bent about y bends about the base's -z."""
    robot, plant = load_robot('engine'), load_plant('engine')
    plain = trajectory('t1', robot, plant)
    rolled = levelled('t1', robot, plant, lambda time: np.pi / 2)
    group = plant.tendons[2]
    angle = np.radians(group.azimuth_deg)
    arms = group.radius * np.stack([-np.sin(angle), np.cos(angle)])
    y, z = arms @ plain.command(7.0).tension[6:]
    turned = arms @ rolled.command(7.0).tension[6:]
    np.testing.assert_allclose(turned, [z, -y], atol=1e-9)


def test_a_carried_robot_tells_where_its_base_is():
    """Free of errors and of insertion, what is told is the truth; and the drives follow."""
    robot = load_robot('engine').model_copy(update={'tof': ()})
    robot = with_base(robot, 'measured')
    way = carrier('smooth', robot)
    world = World(robot, None, 't1', carried=Carrier('exact', way.times, way.values, EXACT))
    true, told, travel = {}, {}, {}
    for sample in world.run(3.0):
        if isinstance(sample, TruthSample):
            true[sample.stamp] = sample.T_map_ring[0]
        elif isinstance(sample, EncoderSample):
            travel[sample.stamp] = sample.position[-1]
        elif isinstance(sample, BaseSample):
            told[sample.stamp] = sample.T_frame_base
    assert len(told) == 300
    for stamp in sorted(travel)[1:]:
        off = lie.log(lie.inverse(told[stamp]) @ true[stamp])
        np.testing.assert_allclose(off[1:], 0.0, atol=1e-6)
        assert off[0] == pytest.approx(travel[stamp], abs=5 * robot.base.insertion.sigma)
        value, _ = way.command(stamp / NANOSECONDS - 1.0)
        wanted = robot.base.T_map_base @ pose_of(value)
        assert np.linalg.norm(told[stamp][:3, 3] - wanted[:3, 3]) < 0.005
    assert np.linalg.norm(true[max(travel)][:3, 3] - robot.base.T_map_base[:3, 3]) > 0.1


def test_trials_that_differ_in_what_is_believed_of_the_base_share_a_recording():
    trials = [Trial(carried='smooth', base=base) for base in ('measured', 'free', 'fixed')]
    assert len({one.recording for one in trials}) == 1
    assert len({one.name for one in trials}) == 3
    assert [one.description.base.mode for one in trials] == ['measured', 'free', 'fixed']


def test_an_unknown_carrier_is_refused_with_the_known_ones():
    with pytest.raises(SettingsError, match='smooth'):
        carrier('nobody', load_robot('engine'))


@pytest.mark.parametrize(
    'wrong, said', [({'told': 'hearsay'}, 'arm, odometry'), ({'world': 'disturbed'}, 'ideal')]
)
def test_a_carried_trial_that_cannot_be_is_refused(wrong, said):
    with pytest.raises(SettingsError, match=said):
        make_world(Trial(carried='smooth', **wrong))


def test_a_carrier_of_ones_own_says_what_it_tells(tmp_path):
    file = tmp_path / 'rail.yaml'
    file.write_text(
        'keyframes: [{time: 1.0}, {time: 2.0, xyz: [0.1, 0, 0], rpy_deg: [0, 0, 90]}]\n'
        'told: {latency: 0.03}\n'
    )
    rail = carrier(str(file), load_robot('engine'))
    assert rail.told.latency == 0.03
    np.testing.assert_allclose(rail.command(5.0)[0], [0.1, 0, 0, np.pi / 2, 0, 0], atol=1e-12)
    file.write_text('keyframes: [{time: 2.0}, {time: 1.0}]\n')
    with pytest.raises(SettingsError, match='increase'):
        carrier(str(file), load_robot('engine'))
