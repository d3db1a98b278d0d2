"""Replays are deterministic and lose nothing on their way into a run folder and back."""

from dataclasses import replace
import json
import multiprocessing

from continuum_loc import lie
from continuum_loc.errors import RunError
from continuum_loc.measurements import NANOSECONDS, TofFrame
from continuum_loc.offline.replay import place_points, replay
from continuum_loc.offline.runs import distribution, load_run, new_run, save_run, summary_of
from continuum_loc.robot import load_robot
from continuum_loc.trajectory import Trajectory
from evo import main_ape
from evo.core.metrics import PoseRelation
from evo.core.sync import associate_trajectories
from evo.tools.file_interface import read_tum_trajectory_file
import numpy as np
import pytest
from synthetic import NoisyFilter, samples, START, truth_at
import yaml

ROBOT = load_robot('engine')
REQUIRED = {'translation_mae_m', 'translation_rmse_m', 'rotation_mae_deg', 'rotation_rmse_deg'}


@pytest.fixture(scope='module')
def result():
    return replay(samples(ROBOT, 3.0), NoisyFilter(ROBOT))


def test_the_same_samples_give_the_same_estimate_to_the_last_bit(result):
    again = replay(samples(ROBOT, 3.0), NoisyFilter(ROBOT))
    other = replay(samples(ROBOT, 3.0), NoisyFilter(ROBOT, seed=1))
    assert again.digest == result.digest
    assert other.digest != result.digest


def test_summary_has_what_is_promised(result):
    summary = summary_of(result)
    assert summary.keys() >= REQUIRED | {
        'nees_per_dof',
        'coverage_95',
        'real_time_factor',
        'step_ms',
        'counts',
    }
    assert set(summary['rings']) == set(ROBOT.ring_names)
    assert all(figures.keys() >= REQUIRED for figures in summary['rings'].values())
    assert summary['step_ms'].keys() >= {'mean', 'p95', 'p99'}
    assert 'latency_ms' not in summary  # nothing was live
    assert summary['counts']['received'] == {'tof': 30 * 16, 'imu': 300 * 5}


def test_estimates_before_the_first_fit_are_counted_and_not_judged(result):
    estimates = summary_of(result)['estimates']
    assert estimates['initialising'] == 5
    assert estimates['judged'] == estimates['tracking'] == 25


def test_an_error_is_silent_where_the_filter_does_not_say_lost(result):
    track = result.track
    off, said = track.T_map_ring.copy(), track.status.copy()
    off[10:25, 3, 0, 3] += 0.2
    said[10:13] = 'lost'

    def silent(**changes):
        return summary_of(replace(result, track=replace(track, **changes)))['silent_seconds']

    assert silent() == 0.0
    assert silent(T_map_ring=off) == (track.stamps[24] - track.stamps[10]) / NANOSECONDS
    assert (
        silent(T_map_ring=off, status=said) == (track.stamps[24] - track.stamps[13]) / NANOSECONDS
    )


def test_what_a_lost_filter_says_is_judged_like_the_rest(result):
    """
    Three of the 25 instants are 0.2 m off at one of five rings, and the filter says so.

    Left out, the greatest error would be that of the rest; counted, they add 0.2 * 3 / (25 * 5) to
    the mean at all rings, and are as far outside of their covariance as they are.
    """
    track = result.track
    off, said = track.T_map_ring.copy(), track.status.copy()
    off[10:13, 3, 0, 3] += 0.2
    said[10:13] = 'lost'
    before = summary_of(result)
    after = summary_of(replace(result, track=replace(track, T_map_ring=off, status=said)))
    assert after['estimates']['judged'] == 25
    assert (after['estimates']['tracking'], after['estimates']['lost']) == (22, 3)
    assert after['poses'] == 25 * 5
    assert after['translation_max_m'] == pytest.approx(0.2, abs=0.01)
    grown = after['translation_mae_m'] - before['translation_mae_m']
    assert grown == pytest.approx(0.2 * 3 / 125, rel=0.05)
    missed = before['coverage_95'] - after['coverage_95']
    assert missed * 125 == pytest.approx(3.0, abs=0.5)
    assert after['nees_per_dof'] > 50.0 * before['nees_per_dof']


def test_real_time_factor_is_data_time_over_processing_time(result):
    assert result.data_seconds == pytest.approx(2.99)
    assert result.real_time_factor == pytest.approx(2.99 / result.processing_seconds)
    assert result.step_seconds.sum() <= result.processing_seconds


def test_points_are_placed_by_the_pose_of_their_ring_at_their_stamp():
    stamps = START + np.arange(3) * NANOSECONDS // 10
    track = Trajectory(
        stamps, ('base', *ROBOT.ring_names), np.stack([truth_at(ROBOT, stamp) for stamp in stamps])
    )
    sensor, stamp = ROBOT.tof[7], int(stamps[0] + NANOSECONDS // 20)
    points = np.array([[0.3, 0.0, 0.0], [0.2, 0.1, 0.0]])
    blank = np.zeros(2)
    frame = TofFrame(stamp, sensor.name, points, blank, blank, np.array([5, 255], np.uint8))
    cloud = place_points([frame], track, ROBOT)
    column = track.names.index(sensor.ring)
    T_map_ring = lie.interpolate(
        track.T_map_ring[0, column], track.T_map_ring[1, column], np.array(0.5)
    )
    expected = (T_map_ring @ sensor.mount.T_ring_sensor @ [0.3, 0.0, 0.0, 1.0])[:3]
    # The zone without return is left out.
    np.testing.assert_allclose(cloud.points, [expected], atol=1e-12)


def test_a_run_folder_gives_back_what_went_in(result, tmp_path):
    folder = new_run('replay', tmp_path)
    save_run(folder, result, kind='replay', seed=7, configuration={'robot': ROBOT})
    run = load_run(tmp_path / 'latest')
    assert run.result.digest == result.digest
    assert run.summary['seed'] == 7
    assert run.configuration['robot']['name'] == 'engine'
    np.testing.assert_array_equal(run.result.cloud.points, result.cloud.points)
    np.testing.assert_array_equal(run.result.track.backbone, result.track.backbone)
    names = {path.name for path in (folder / 'trajectories').iterdir()}
    assert names >= {
        f'{kind}_{ring}.tum' for kind in ('estimate', 'truth') for ring in ROBOT.ring_names
    }
    # Strict: no NaN, no Infinity.
    json.loads((folder / 'summary.json').read_text(), parse_constant=pytest.fail)
    yaml.safe_load((folder / 'configuration.yaml').read_text())


def test_evo_ape_finds_the_figures_of_the_summary_in_the_exported_trajectories(result, tmp_path):
    """Truth comes at another rate than the estimates, and the first are not judged."""
    shifted = replace(result.truth, stamps=result.truth.stamps + 3 * NANOSECONDS // 1000)
    summary = save_run(
        tmp_path, replace(result, truth=shifted), kind='replay', seed=0, configuration={}
    )
    files = (tmp_path / 'trajectories' / f'{name}_ring5.tum' for name in ('truth', 'estimate'))
    truth, estimate = associate_trajectories(*map(read_tum_trajectory_file, files))
    for relation, kind, unit in (
        (PoseRelation.translation_part, 'translation', 'm'),
        (PoseRelation.rotation_angle_deg, 'rotation', 'deg'),
    ):
        theirs = main_ape.ape(truth, estimate, relation).stats
        ours = summary['rings']['ring5']
        assert ours[f'{kind}_mae_{unit}'] == pytest.approx(theirs['mean'], abs=1e-6)
        assert ours[f'{kind}_rmse_{unit}'] == pytest.approx(theirs['rmse'], abs=1e-6)


def test_runs_are_numbered_and_latest_leads_to_the_newest(tmp_path):
    first, second = new_run('demo', tmp_path), new_run('replay', tmp_path)
    assert (first.name, second.name) == ('0001-demo', '0002-replay')
    assert (tmp_path / 'latest').resolve() == second.resolve()


def test_parallel_runs_get_different_numbers(tmp_path):
    with multiprocessing.get_context('fork').Pool(4) as pool:
        folders = pool.starmap(new_run, [('trial', tmp_path)] * 12)
    assert len({folder.name for folder in folders}) == 12


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(RunError, match=r'no run folder: it has no summary\.json'):
        load_run(tmp_path)
    (tmp_path / 'latest').mkdir()
    with pytest.raises(RunError, match='in the way'):
        new_run('replay', tmp_path)


def test_a_damaged_result_is_named(result, tmp_path):
    folder = new_run('replay', tmp_path)
    save_run(folder, result, kind='replay', seed=0, configuration={})
    whole = (folder / 'result.npz').read_bytes()
    for damaged in (b'not a result', b'', whole[:-1], whole[:-200], whole[: len(whole) // 2]):
        (folder / 'result.npz').write_bytes(damaged)
        with pytest.raises(RunError, match=r'result\.npz: damaged'):
            load_run(folder)


@pytest.mark.parametrize(
    ('name', 'content'),
    [
        ('summary.json', b'{"kind": '),
        ('summary.json', b'[1]'),
        ('summary.json', b'\xff'),
        ('summary.json', b'[' * 100_000),
        ('configuration.yaml', b'a: 1\na: 2\n'),
        ('configuration.yaml', b'- 1\n'),
        ('configuration.yaml', b'[' * 5000),
    ],
)
def test_damaged_files_of_a_run_are_named(result, tmp_path, name, content):
    save_run(tmp_path, result, kind='replay', seed=0, configuration={})
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RunError, match=rf'{name}: damaged'):
        load_run(tmp_path)


def test_without_truth_or_estimates_figures_are_unknown_and_not_zero():
    nothing = replay([], NoisyFilter(ROBOT))
    assert np.isnan(summary_of(nothing)['translation_mae_m'])
    assert np.isnan(nothing.real_time_factor)
    assert np.isnan(distribution(np.empty(0))['p99'])
