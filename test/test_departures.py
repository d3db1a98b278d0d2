"""
Worlds that depart from the estimator's files: sizes, independence of the parts, and no peeking.

Statistical tests use fixed seeds; their tolerances are over four sigmas.
"""

import subprocess
import sys

from continuum_loc.errors import SettingsError
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    StrainSample,
    TofFrame,
    TruthSample,
)
from continuum_loc.offline.scanned_maps import scanned
from continuum_loc.offline.trials import simulate, Trial, world
from continuum_loc.robot import load_robot
from continuum_loc.simulator.departing_sensors import (
    Backlash,
    GyroErrors,
    HallErrors,
    RangeErrors,
    StrainErrors,
)
from continuum_loc.simulator.departures import (
    Departures,
    load_departures,
    sensor_departures,
    true_plant,
    true_robot,
)
from continuum_loc.simulator.plant import load_plant
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

DISTURBED = load_departures('disturbed')
ENGINE = load_robot('engine')
SEEDS = range(60)


def turn_deg(R: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(R).magnitude()))


def test_the_base_is_off_by_the_stated_size_whatever_the_seed():
    for seed in SEEDS:
        moved = true_robot(ENGINE, DISTURBED.only('base'), seed)
        error = np.linalg.inv(ENGINE.base.T_map_base) @ moved.base.T_map_base
        assert np.linalg.norm(error[:3, 3]) == pytest.approx(0.003)
        assert turn_deg(error[:3, :3]) == pytest.approx(0.5)
        assert moved.tof == ENGINE.tof


def test_mounts_scatter_by_2_mm_and_1_deg_per_axis():
    """21 sensors, 60 seeds: 3780 numbers each, of which the spread is known to 1.2 %."""
    shifts, turns = [], []
    for seed in SEEDS:
        moved = true_robot(ENGINE, DISTURBED.only('mounts'), seed)
        for was, now in zip(ENGINE.sensors, moved.sensors, strict=True):
            error = np.linalg.inv(was.mount.T_ring_sensor) @ now.mount.T_ring_sensor
            shifts.append(error[:3, 3])
            turns.append(Rotation.from_matrix(error[:3, :3]).as_rotvec(degrees=True))
    assert np.std(shifts) == pytest.approx(0.002, rel=0.05)
    assert np.std(turns) == pytest.approx(1.0, rel=0.05)


def test_stiffness_departs_within_two_sigma_and_keeps_the_ratio_of_twist_to_bending():
    plant = load_plant('engine')
    factors = []
    for seed in range(400):
        stiff = true_plant(plant, DISTURBED.only('stiffness'), seed)
        assert stiff.GJ / stiff.EI == pytest.approx(plant.GJ / plant.EI)
        factors.append(stiff.EI / plant.EI)
    assert min(factors) >= 0.6 and max(factors) <= 1.4
    # A normal cut at two sigma, what lies beyond put there: 0.959 of its spread.
    assert np.std(factors) == pytest.approx(0.2 * 0.959, rel=0.15)


def test_one_part_alone_departs_as_it_does_among_all():
    alone, all_of_them = (
        true_robot(ENGINE, departures, 7) for departures in (DISTURBED.only('base'), DISTURBED)
    )
    assert alone.base == all_of_them.base
    clocks, among = (
        sensor_departures(ENGINE, departures, 'vl53l5cx', 7)
        for departures in (DISTURBED.only('clocks'), DISTURBED)
    )
    others = len(among) - len(clocks)
    assert clocks == among[others:]


def test_every_part_can_be_switched_on_alone_and_an_unknown_one_is_refused():
    for part in DISTURBED.parts:
        assert load_departures(f'disturbed:{part}').parts == (part,)
    assert set(DISTURBED.parts) == set(Departures.model_fields)
    assert load_departures('ideal').parts == ()
    with pytest.raises(SettingsError, match="no part 'mount' in this world; parts: tof, mounts"):
        load_departures('disturbed:mount')
    with pytest.raises(SettingsError, match="no world 'wobbly'"):
        load_departures('wobbly')


def test_one_board_is_thirty_milliseconds_late_and_boards_keep_together():
    clocks = sensor_departures(ENGINE, DISTURBED.only('clocks'), 'paper', 3)
    assert len(clocks) == 5  # rings
    late = [
        max(
            clock.offset
            for clock in sensor_departures(ENGINE, DISTURBED.only('clocks'), 'paper', seed)
        )
        for seed in SEEDS
    ]
    assert 0.025 < np.median(late) < 0.050
    for clock in clocks:
        rings = {ENGINE.sensor(name).ring for name in clock.sensors}
        assert len(rings) == 1 and any('imu' in name for name in clock.sensors)


def test_a_scaled_and_shifted_range_moves_its_point_along_the_ray():
    ray = np.array([[0.8, 0.6, 0.0]])
    frame = TofFrame(1, 'a', 2.0 * ray, np.array([2.0]), np.array([0.01]), np.array([5], np.uint8))
    for cosine in (1.0, np.array([0.8])):
        fault = RangeErrors(offset=0.008, scale=0.015, cosine=cosine, seed=1)
        (read,) = fault([frame])
        offset, scale = fault.own(np.random.default_rng([1, 3904355907]), frame)  # crc32 of a
        assert read.ranges[0] == pytest.approx(2.0 * (1.0 + scale) + offset / np.max(cosine))
        np.testing.assert_allclose(read.points, read.ranges[0] * ray)


def test_a_turned_gyro_mixes_its_axes_and_drifts_off_its_bias():
    rate = np.array([1.0, 0.0, 0.0])
    samples = [ImuSample(k * 10**9, 'imu', rate, np.zeros(3)) for k in range(2)]
    first = [
        next(iter(GyroErrors(scale=0.02, axes_deg=2.0, bias=0.01, seed=seed)(samples)))
        for seed in range(400)
    ]
    read = np.array([sample.angular_velocity for sample in first]) - rate
    # x: scale and bias; y and z: the axis' turn and the bias.
    assert np.std(read[:, 0]) == pytest.approx(np.hypot(0.02, 0.01), rel=0.15)
    assert np.std(read[:, 1:]) == pytest.approx(np.hypot(np.radians(2.0), 0.01), rel=0.1)
    walked = []
    for seed in range(400):
        a, b = GyroErrors(walk=1e-3, seed=seed)(samples)
        walked.append(b.angular_velocity - a.angular_velocity)
    assert np.std(walked) == pytest.approx(1e-3, rel=0.1)  # one second apart


def test_a_twisted_fibre_turns_the_plane_and_a_shifted_one_bends_where_it_is_straight():
    sample = StrainSample(1, np.array([0.1]), np.array([0.3]), np.array([2.0]))
    (turned,) = StrainErrors(twist_deg=5.0, seed=2)([sample])
    assert turned.kappa[0] == pytest.approx(2.0)
    assert 0.0 < abs(turned.theta[0] - 0.3) < np.radians(20.0)
    straight = StrainSample(1, np.array([0.1]), np.array([0.3]), np.array([0.0]))
    bends = [
        next(iter(StrainErrors(offset=0.05, seed=seed)([straight]))).kappa[0]
        for seed in range(400)
    ]
    # The length of a vector of two normal components.
    assert np.mean(bends) == pytest.approx(0.05 * np.sqrt(np.pi / 2.0), rel=0.1)


def test_a_hall_sensor_drifts_while_it_warms_up_and_stays_saturated():
    field = np.array([1e-3, np.nan, 0.0])
    samples = [FieldSample(stamp, 'h', field) for stamp in (0, 3000 * 10**9)]
    cold, warm = HallErrors(warm_scale=0.01, warm_offset=2e-6, warm_time=300.0, seed=4)(samples)
    np.testing.assert_array_equal(cold.field, field)
    assert warm.field[0] != field[0] and abs(warm.field[2]) < 1e-5 and np.isnan(warm.field[1])


def test_a_drive_with_play_leads_its_tendon_in_the_direction_it_went():
    lengths = [0.0, 0.01, 0.02, 0.0199, 0.01]
    names = ('tendon1_1', 'insertion')
    samples = [
        EncoderSample(k, names, np.array([x, x]), np.zeros(2)) for k, x in enumerate(lengths)
    ]
    read = np.array([sample.position for sample in Backlash(play=0.001)(samples)])
    lead = read[:, 0] - lengths
    np.testing.assert_allclose(lead, [0.0, 0.0005, 0.0005, 0.0004, -0.0005], atol=1e-12)
    np.testing.assert_array_equal(read[:, 1], lengths)


def flat_map() -> PriorMap:
    x, y = np.meshgrid(np.arange(0.0, 1.0, 0.01), np.arange(0.0, 1.0, 0.01))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return PriorMap(
        points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), np.ones(len(points)), spacing=0.01
    )


def test_a_scanned_map_has_noise_and_holes_and_normals_of_its_own():
    nominal = flat_map()
    scan = scanned(nominal, DISTURBED.only('scan'), 5)
    # 40 holes of 3 cm take at most 40 x 0.0028 m^2 of 1 m^2; where they overlap, less.
    assert 0.86 < len(scan) / len(nominal) < 0.95
    assert np.std(scan.points[:, 2]) == pytest.approx(0.002, rel=0.05)
    assert (scan.normals[:, 2] > 0.7).all() and not np.allclose(scan.normals, nominal.normals[0])
    assert scan.sigma == 0.002


def test_a_map_frame_is_turned_about_the_maps_middle_and_shifted():
    nominal = flat_map()
    moved = scanned(nominal, DISTURBED.only('map_frame'), 5)
    shift = moved.points.mean(axis=0) - nominal.points.mean(axis=0)
    assert np.linalg.norm(shift) == pytest.approx(0.005)
    spread = moved.points - moved.points.mean(axis=0)
    R = Rotation.align_vectors(spread[::37], (nominal.points - nominal.points.mean(axis=0))[::37])[
        0
    ]
    assert np.degrees(R.magnitude()) == pytest.approx(0.5, rel=1e-6)


def test_a_trial_in_a_disturbed_world_is_truly_elsewhere_and_its_description_is_not():
    trial = Trial('soft_arm', 'R1', 'b2', duration=0.2, world='disturbed', seed=1)
    assert trial.fidelity == 'vl53l5cx'
    made = world(trial)
    assert made.robot.base != load_robot('soft_arm').base
    assert made.plant.EI != load_plant('soft_arm').EI
    first = next(s for s in simulate(trial) if isinstance(s, TruthSample))
    off = first.T_map_ring[0, :3, 3] - load_robot('soft_arm').base.T_map_base[:3, 3]
    assert np.linalg.norm(off) == pytest.approx(0.003, rel=1e-3)


def test_worlds_have_recordings_of_their_own(tmp_path):
    own = tmp_path / 'mine.yaml'
    own.write_text('base: {shift: 0.01, turn_deg: 0.0}\n')
    names = {
        Trial(world=name).recording
        for name in ('ideal', 'disturbed', 'disturbed:mounts', 'disturbed:base', str(own))
    }
    assert len(names) == 5
    own.write_text('base: {shift: 0.02, turn_deg: 0.0}\n')
    assert Trial(world=str(own)).recording not in names


@pytest.mark.parametrize('side', ['estimator', 'mapping', 'shape', 'scene', 'nodes.estimator'])
def test_the_estimators_side_imports_nothing_of_the_truth(side):
    """Not even in passing: a fresh interpreter has no module of the simulator afterwards."""
    code = (
        f'import pkgutil, importlib, sys, continuum_loc.{side} as side\n'
        'for one in pkgutil.walk_packages(getattr(side, "__path__", []), side.__name__ + "."):\n'
        '    importlib.import_module(one.name)\n'
        'print([name for name in sys.modules if name.startswith("continuum_loc.simulator")])\n'
    )
    found = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    if side.startswith('nodes') and 'rclpy' in found.stderr:
        pytest.skip('needs ROS')
    assert found.returncode == 0, found.stderr
    assert found.stdout.strip() == '[]'
