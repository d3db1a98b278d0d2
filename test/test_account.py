"""What is told at the end of a run, and when it counts as having come to nothing."""

from dataclasses import dataclass, field, replace

from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import settings_of
from continuum_loc.intake import Intake
from continuum_loc.measurements import FieldSample, ImuSample, StrainSample, TofFrame
from continuum_loc.offline.account import account_lines, account_of, Suspicion, wanted_topics
from continuum_loc.offline.replay import replay
from continuum_loc.offline.runs import load_run, new_run, save_run, summary_of
from continuum_loc.offline.shape_replay import ShapeReplay
from continuum_loc.robot import load_robot
from continuum_loc.shape import ShapeEstimate, ShapeSettings
import numpy as np
import pytest
from synthetic import NoisyFilter, samples

ROBOT = load_robot('engine')
SETTINGS = settings_of('engine')
SECOND = 10**9


@pytest.fixture(scope='module')
def result():
    return replay(samples(ROBOT, 2.0), NoisyFilter(ROBOT))


def account(result, robot=ROBOT, settings=SETTINGS, **summary):
    return account_of(robot, settings, result.counts, summary_of(result) | summary)


def spoiled(kind, share=1.0):
    """Draw samples of which a share of one kind comes from a sensor that the robot has not."""
    for number, sample in enumerate(samples(ROBOT, 2.0)):
        if isinstance(sample, kind) and number % 100 < 100 * share:
            sample = replace(sample, sensor='stranger')
        yield sample


def test_a_clean_run_has_no_problem_and_fits_on_a_screen(result):
    found = account(result)
    assert found['problems'] == []
    assert found['topics']['imu/data_raw'] == {
        'received': 1000,
        'used': 1000,
        'refused': {},
        'first': '',
    }
    lines = list(account_lines(found))
    assert len(lines) < 15 and max(map(len, lines)) < 250
    assert lines[0].startswith('used of received: tof/points 320 of 320, imu/data_raw 1,000 of')
    assert 'not in the bag, though the robot has it: strain, joint_states' in lines
    assert 'suspects: none' in lines


@pytest.mark.parametrize('kind', [TofFrame, ImuSample])
def test_a_kind_of_which_nothing_was_used_is_a_problem_and_one_of_which_some_was_is_none(kind):
    topic = {TofFrame: 'tof/points', ImuSample: 'imu/data_raw'}[kind]
    none = account(replay(spoiled(kind), NoisyFilter(ROBOT)))
    few = account(replay(spoiled(kind, 0.9), NoisyFilter(ROBOT)))
    count = none['topics'][topic]['received']
    problem = f"none of {count} {topic} was used: {topic}: robot 'engine' has no such sensor"
    assert any(one.startswith(problem) for one in none['problems'])
    assert few['problems'] == [] and 0 < few['topics'][topic]['used'] < count
    (refused,) = [line for line in account_lines(few) if line.startswith('refused')]
    assert f"as unknown frame: {topic}: robot 'engine' has no such sensor 'stranger'" in refused


def test_what_the_filter_dropped_of_a_whole_kind_is_a_problem_too(result):
    """The gate let it pass, and nothing of it went into the estimate."""
    counts = result.counts | {
        'received': {'TofFrame': 320, 'ImuSample': 1000},
        'used': {'ImuSample': 1000},
        'dropped': {'tof: no map': 320},
    }
    found = account(replace(result, counts=counts))
    assert found['problems'] == ['none of 320 tof/points was used: 320 tof: no map']
    assert 'dropped by the filter: 320 tof: no map' in list(account_lines(found))


def test_nothing_at_all_and_the_truth_of_another_robot_are_problems():
    nothing = account(replay([], NoisyFilter(ROBOT)))
    assert nothing['problems'] == ['no estimate: no measurement in it']
    assert 'covariance: cannot be judged' in list(account_lines(nothing))
    foreign = (
        replace(sample, T_map_ring=sample.T_map_ring[:4])
        if hasattr(sample, 'T_map_ring')
        else sample
        for sample in samples(ROBOT, 1.0)
    )
    (problem,) = account(replay(foreign, NoisyFilter(ROBOT)))['problems']
    assert 'no truth could be used' in problem and 'holds 4 poses; this robot has 6' in problem


def test_what_settings_switch_off_or_a_robot_has_no_use_for_is_not_missed():
    soft = load_robot('soft_arm')
    assert 'joint_states' not in wanted_topics(soft, settings_of('soft_arm'))  # fixed at its base
    assert wanted_topics(ROBOT, SETTINGS) == [
        'tof/points',
        'imu/data_raw',
        'strain',
        'joint_states',
    ]
    off = SETTINGS.model_copy(
        update={'strain': SETTINGS.strain.model_copy(update={'enabled': False})}
    )
    assert 'strain' not in wanted_topics(ROBOT, off)
    assert wanted_topics(load_robot('hall_arm'), ShapeSettings()) == ['imu/data_raw', 'imu/mag']


@pytest.mark.parametrize(
    ('figures', 'said'),
    [
        ({'nees_per_dof': 1.0, 'coverage_95': 0.95}, 'honest (NEES 1.00 per degree'),
        ({'nees_per_dof': 0.2, 'coverage_95': 1.0}, 'more careful than it need be'),
        ({'nees_per_dof': 2.25, 'coverage_95': 0.7}, 'a little too sure, errors are 1.5 times'),
        ({'nees_per_dof': 81.0, 'coverage_95': 0.0}, 'NOT to be believed, errors are 9.0 times'),
        ({'nees_per_dof': None, 'consistency': 1.1}, 'honest (no truth; the data fit it'),
        ({'nees_per_dof': None, 'consistency': 484.0}, 'NOT to be believed, errors are 22.0 tim'),
    ],
)
def test_how_honest_the_covariance_was_is_said_in_words(result, figures, said):
    """The root of a normalised squared error is how many times larger errors are than stated."""
    found = account(result, **figures)['covariance']
    assert found['said'].startswith(said)
    assert found['by'] == ('truth' if figures['nees_per_dof'] else 'data')


@dataclass
class Told:
    stamp: int
    suspects: dict = field(default_factory=dict)


def test_suspects_are_counted_in_seconds_by_reason():
    """Named at three estimates of 15 Hz: 0.2 s; a pause of ten seconds between two counts none."""
    suspicion = Suspicion()
    tick = SECOND // 15
    for k in range(3):
        suspicion.note(Told(SECOND + k * tick))
    for k in range(3, 6):
        suspicion.note(Told(SECOND + k * tick, {'a': f'{10 + k} ms late', 'b': 'frozen'}))
    suspicion.note(Told(11 * SECOND, {'a': 'silent'}))
    suspicion.note(Told(11 * SECOND + tick, {'a': 'silent'}))
    table = suspicion.table()
    assert list(table) == ['a', 'b']
    assert table['a']['late'] == pytest.approx(0.2, abs=1e-6)
    assert table['a']['silent'] == pytest.approx(1 / 15, abs=1e-6)
    assert table['b'] == {'frozen': pytest.approx(0.2, abs=1e-6)}


def test_the_summary_holds_what_the_terminal_says(result, tmp_path):
    folder = new_run('replay', tmp_path)
    configuration = {'robot': ROBOT, 'estimator': SETTINGS}
    save_run(folder, result, kind='replay', seed=0, configuration=configuration)
    run = load_run(folder)
    assert list(account_lines(run.summary['account'])) == list(account_lines(account(result)))
    shares = run.summary['account']['tof_status']
    assert sum(shares.values()) == pytest.approx(1.0) and set(shares) == {'valid', 'no target'}


# ---------------------------------------------------------------- the shape estimator as a filter


def shape(points, stamp=SECOND):
    """Make a straight arm of 0.2 m whose curve has so many points."""
    robot = load_robot('hall_arm')
    s = np.linspace(0.0, 0.2, points)
    return ShapeEstimate(
        stamp,
        robot.ring_names,
        np.tile(np.eye(4), (3, 1, 1)),
        np.tile(np.eye(6), (3, 1, 1)),
        np.column_stack([s, np.zeros(points), 0.5 * s]),
        s,
        np.ones(3, bool),
        np.zeros((3, 3)),
        np.zeros(3),
        'tracking',
        {},
        1.0,
        np.eye(4),
    )


def hall_samples():
    robot = load_robot('hall_arm')
    for k in range(1, 11):
        for imu, hall in zip(robot.imu, robot.hall, strict=True):
            yield ImuSample(k * SECOND // 100, imu.name, np.zeros(3), np.array([0.0, 0.0, 9.81]))
            yield FieldSample(k * SECOND // 100, hall.name, np.full(3, 1e-4))


def test_curves_of_81_and_82_points_make_one_trajectory(monkeypatch):
    """How many points lead from the last module to the tip depends on where the module is."""
    made = ShapeReplay(load_robot('hall_arm'), ShapeSettings())
    lengths = iter([81, 82, 82, 81, 80])
    monkeypatch.setattr(
        made.estimator,
        'process',
        lambda sample: (
            shape(next(lengths), sample.stamp)
            if sample.sensor.startswith('module1')
            and sample.stamp % (SECOND // 50) == 0
            and isinstance(sample, ImuSample)
            else None
        ),
    )
    track = replay(hall_samples(), made).track
    assert track.backbone.shape == (5, 81, 3)
    s = np.linspace(0.0, 0.2, 81)
    for curve in track.backbone:  # the same straight line at each, ends and all
        np.testing.assert_allclose(curve, np.column_stack([s, 0 * s, 0.5 * s]), atol=1e-12)


def test_the_shape_counts_by_kind_and_over_new_starts():
    made = ShapeReplay(load_robot('hall_arm'), ShapeSettings())
    stream = list(hall_samples())
    for sample in stream:
        made.process(sample)
    made.process(stream[0])  # not newer than the last of its sensor
    made.reset()
    for sample in stream:
        made.process(sample)
    counts = made.counts
    assert counts['received'] == {'ImuSample': 61, 'FieldSample': 60}
    assert counts['used'] == {'ImuSample': 60, 'FieldSample': 60}
    assert counts['dropped'] == {'out of order': 1}


def test_a_measurement_that_cannot_be_used_costs_no_new_start():
    """As a failure does, which leaves nobody knows what behind."""
    restarts = []
    gate = Intake(ROBOT, restart=lambda: restarts.append(True))

    def useless():
        raise MeasurementError('saturated', 'beyond its full scale')

    assert gate.attempt(useless, 'strain') is None
    assert restarts == [] and gate.refused == {'saturated': 1} and gate.failures == 0
    assert gate.attempt(lambda: 1 / 0, 'strain') is None
    assert restarts == [True] and gate.failures == 1


def test_strain_of_a_robot_without_it_is_refused_by_the_robots_name():
    gate = Intake(load_robot('soft_arm'))
    sample = StrainSample(SECOND, np.array([0.1]), np.zeros(1), np.zeros(1))
    assert gate.admit('strain', sample, 0) is None
    assert "robot 'soft_arm' has no strain sensor" in gate.refusals['strain', 'unknown frame'][1]
