"""
The robots that come with the package are those of the papers, and their settings are used.

Numbers are the papers' own: "Continuum Robot Localization using Distributed Time-of-Flight
Sensors" (ToF) and "A Novel Shape Estimation Strategy for Continuum Robots Using Multiple
Hall-effect Sensors and IMUs" (Hall).
"""

from pathlib import Path
from types import SimpleNamespace

from continuum_loc.estimator.settings import EstimatorSettings, PRESETS_FOLDER, settings_of
from continuum_loc.measurements import TrackedPose
from continuum_loc.offline.localise import make_filter, trial_settings
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot
from msg_tools.bag import BagWriter
import numpy as np
import pytest
from typer.testing import CliRunner
from worlds import room_map
import yaml

MU_0 = 4e-7 * np.pi
PRESETS = sorted(path.stem for path in PRESETS_FOLDER.glob('*.yaml'))

# ------------------------------------------------------------------ the Hall arm


def rotation(robot, sensors, number: int) -> np.ndarray:
    return getattr(robot, sensors)[number].mount.T_ring_sensor[:3, :3]


@pytest.mark.parametrize('module', range(3))
def test_a_hall_sensor_is_turned_to_its_imu_as_in_equation_8(module):
    robot = load_robot('hall_arm')
    R_imu_hall = rotation(robot, 'imu', module).T @ rotation(robot, 'hall', module)
    np.testing.assert_allclose(R_imu_hall, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)


@pytest.mark.parametrize('module', range(3))
def test_an_imus_z_lies_along_the_arm_which_stands_up(module):
    """
    At rest the straight arm reads +g along z (Hall paper, 2.2: the moment aligned with gravity).

    So the magnet's field on the axis, which is along the moment, is -z of the Hall sensor.
    """
    robot = load_robot('hall_arm')
    R_map_ring = robot.base.T_map_base[:3, :3]  # of every ring of a straight arm
    up = np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(R_map_ring @ [1.0, 0.0, 0.0], up, atol=1e-12)
    np.testing.assert_allclose((R_map_ring @ rotation(robot, 'imu', module)).T @ up, up, atol=1e-9)
    np.testing.assert_allclose(
        (R_map_ring @ rotation(robot, 'hall', module)).T @ up, -up, atol=1e-9
    )


def test_the_hall_arm_is_the_papers():
    """100 mm long, 14 mm wide, modules 25 mm apart; a magnet of 13, 10 and 14 mm, 0.836 A m^2."""
    robot = load_robot('hall_arm')
    assert (robot.length, 2.0 * robot.radius) == (0.1, 0.014)
    np.testing.assert_allclose(robot.ring_arclengths, [0.025, 0.050, 0.075], atol=1e-12)
    magnet = robot.magnet
    assert (magnet.length, magnet.inner_diameter, magnet.outer_diameter) == (0.013, 0.01, 0.014)
    volume = 0.25 * np.pi * (0.014**2 - 0.010**2) * 0.013
    assert magnet.remanence * volume / MU_0 == pytest.approx(0.836, rel=1e-3)
    for kind in ('imu', 'hall'):  # one of each on every module, where the module is
        sensors = getattr(robot, kind)
        assert [sensor.ring for sensor in sensors] == ['module1', 'module2', 'module3']
        assert not any(sensor.mount.T_ring_sensor[:3, 3].any() for sensor in sensors)


# ------------------------------------------------------------------ the robots with ToF sensors


def azimuths(robot) -> dict[str, list[float]]:
    """Degrees about the tangent, from y towards z, in which each ring's sensors look outward."""
    found: dict[str, list[float]] = {ring: [] for ring in robot.ring_names}
    for sensor in robot.tof:
        axis = sensor.mount.T_ring_sensor[:3, 0]
        if abs(axis[0]) < 0.5:
            found[sensor.ring].append(round(np.degrees(np.arctan2(axis[2], axis[1])) % 360.0, 6))
    return {ring: sorted(one) for ring, one in found.items()}


def test_the_engine_robot_is_the_simulated_one_of_the_paper():
    """
    It is 1.5 m long, with a disc of three ToF sensors and a gyro every 30 cm (ToF paper, IV-A).

    Discs are turned by 60 deg, and one more sensor looks ahead. Strain comes every 3 cm at 20 Hz,
    gyros at 100 Hz (IV-C).
    """
    robot = load_robot('engine')
    assert robot.length == 1.5
    np.testing.assert_allclose(robot.ring_arclengths, [0.3, 0.6, 0.9, 1.2, 1.5], atol=1e-12)
    assert list(azimuths(robot).values()) == [
        [0.0, 120.0, 240.0],
        [60.0, 180.0, 300.0],
    ] * 2 + [[0.0, 120.0, 240.0]]
    ahead = [one for one in robot.tof if one.mount.T_ring_sensor[0, 0] == pytest.approx(1.0)]
    assert len(robot.tof) == 16 and [one.ring for one in ahead] == ['ring5']
    assert len(robot.imu) == 5
    assert (robot.imu_model.rate, robot.imu_model.gyro_sigma) == (100.0, 0.01)
    strain = robot.strain
    assert (strain.spacing, strain.rate, strain.kappa_sigma, strain.theta_sigma) == (
        0.03,
        20.0,
        0.01,
        0.015,
    )
    assert robot.tof_model == type(robot.tof_model)()  # that of Table I, as it stands


def test_the_soft_arm_is_the_real_one_of_the_paper():
    """
    It is 53 cm long and 7.6 cm wide, with three rings of three ToF sensors (ToF paper, Fig. 1).

    Rings are turned by 60 deg, gyros run at 120 Hz, and there is no strain sensor (V).
    """
    robot = load_robot('soft_arm')
    assert (robot.length, 2.0 * robot.radius, robot.strain) == (0.53, 0.076, None)
    assert list(azimuths(robot).values()) == [
        [0.0, 120.0, 240.0],
        [60.0, 180.0, 300.0],
        [0.0, 120.0, 240.0],
    ]
    assert (len(robot.tof), len(robot.imu), robot.imu_model.rate) == (9, 3, 120.0)
    assert robot.tof_model == type(robot.tof_model)()
    assert robot.backbone.rest_strain_sigma[0] > 0.05  # "significant compression" (V-B)


# ------------------------------------------------------------------ the settings


def written(values: dict, found, where: str = '') -> dict:
    """Every number of a file by its place, beside what the settings have there."""
    pairs = {}
    for key, value in values.items():
        place, got = f'{where}{key}', getattr(found, key)
        pairs |= (
            written(value, got, f'{place}.')
            if isinstance(value, dict)
            else {place: (tuple(value) if isinstance(value, list) else value, got)}
        )
    return pairs


@pytest.mark.parametrize('name', PRESETS)
def test_the_settings_of_a_robot_are_those_of_its_file(name):
    said = yaml.safe_load((PRESETS_FOLDER / f'{name}.yaml').read_text())
    pairs = written(said, settings_of(name))
    assert len(pairs) >= 4
    for place, (said, got) in pairs.items():
        assert got == said, place
    default = EstimatorSettings()
    assert any(got != _at(default, place) for place, (_, got) in pairs.items())


def _at(settings, place: str):
    for key in place.split('.'):
        settings = getattr(settings, key)
    return settings


def test_a_file_of_ones_own_comes_before_the_robots(tmp_path):
    mine = tmp_path / 'mine.yaml'
    mine.write_text('knot_period: 0.123\n')
    found = settings_of('engine', mine)
    assert found == EstimatorSettings(knot_period=0.123)
    assert settings_of('nobody') == EstimatorSettings()


def test_every_way_to_a_filter_takes_the_robots_settings():
    """0.2 s between knots, not 0.1: what engine.yaml and the soft arm's files say."""
    assert EstimatorSettings().knot_period == 0.1
    made = make_filter(load_robot('engine'), None).settings
    assert (made.knot_period, made.tof.floor, made.prior.jerked) == (0.2, 0.0005, 40.0)
    trial = Trial('soft_arm', 'R1', 'b1')
    assert not trial_settings(trial).calibration.enabled
    real = trial_settings(Trial('soft_arm', 'R1', 'b1', fidelity='vl53l5cx'))
    assert (real.tof.footprint, real.calibration.enabled) == (0.5, True)


def test_the_live_node_takes_the_robots_settings_or_those_given(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from continuum_loc.nodes.estimator import EstimatorNode

    mine = tmp_path / 'mine.yaml'
    mine.write_text('knot_period: 0.07\n')
    for chosen, period in (('', 0.2), (str(mine), 0.07)):
        node = SimpleNamespace(
            robot=load_robot('engine'), settings=SimpleNamespace(settings=chosen)
        )
        assert EstimatorNode._preset(node).knot_period == period


def test_a_replay_takes_the_robots_settings_or_those_given(tmp_path):
    """What a run folder says of its settings is what the filter ran with."""
    robot = load_robot('tendon_robot')
    with BagWriter(tmp_path / 'bag') as bag:
        for tick in range(12):
            stamp = 1_000_000_000 + tick * 25_000_000
            for name, height in (('base_tracker', 0.0), ('tip_tracker', 0.462)):
                T = robot.base.T_map_base.copy()
                T[2, 3] = height
                bag.write(f'tracker/{name}', TrackedPose(stamp, name, T))
    room_map(0.1).save(tmp_path / 'map.npz')
    mine = tmp_path / 'mine.yaml'
    mine.write_text('knot_period: 0.07\n')
    assert _replayed(tmp_path, 'a')['knot_period'] == 0.05  # tendon_robot.yaml
    assert _replayed(tmp_path, 'b', '--settings', mine)['knot_period'] == 0.07


def _replayed(folder: Path, out: str, *more) -> dict:
    from continuum_loc.cli import app

    options = ('--robot', 'tendon_robot', '--map', folder / 'map.npz', '--out', folder / out)
    words = map(str, ('replay', folder / 'bag', *options, *more))
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == 0, done.output
    configuration = folder / out / 'latest' / 'configuration.yaml'
    return yaml.safe_load(configuration.read_text())['estimator']
