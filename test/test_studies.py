"""Campaigns lose no trial and repeat none; split, benchmarks and tuning judge as they say."""

from dataclasses import replace
import json
import math
import shutil

from bench.harness import (
    BenchOutcome,
    bound_claims,
    duration,
    read_baseline,
    run_bench,
    side_by_side,
    write_baseline,
    write_document,
)
from continuum_loc.errors import SettingsError, StudyError, TuneError
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.offline import parallel
from continuum_loc.offline.error_tables import condition_table, figures, mean, trial_rows
from continuum_loc.offline.trials import Trial
from continuum_loc.offline.tune import cost, scaled
import numpy as np
import pytest
from studies import table2, table3
from studies._soft_arm import soft_arm_trials
from studies.support import campaign
from studies.support.campaign import Outcome, run_campaign
from studies.support.split import HOLD_OUT, is_hold_out, require_unseen
from studies.support.worlds import in_worlds, told


def outcome(trial, translation=0.001, rotation=0.1, silent=0.0):
    rings = {
        name: {
            'translation_mae_m': translation * k,
            'translation_rmse_m': translation * k,
            'rotation_mae_deg': rotation,
            'rotation_rmse_deg': rotation,
            'translation_max_m': translation,
            'nees_per_dof': 1.0,
            'coverage_95': 0.95,
        }
        for k, name in enumerate(('ring1', 'ring2'), start=1)
    }
    summary = {'rings': rings, 'estimates': {'all': 10, 'lost': 0}, 'silent_seconds': silent}
    return Outcome(trial, summary)


@pytest.fixture(scope='module')
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp('campaign')
    trials = [
        Trial('soft_arm', 'R0', 'b1', 'R0', seed=3, duration=0.4),
        Trial('soft_arm', 'R0', 'b1', 'R1', seed=3, duration=0.4),
        Trial('soft_arm', 'R0', 'no such trajectory', 'R0', seed=3, duration=0.4),
    ]
    return out, trials, run_campaign(trials, out, jobs=1)


def test_one_failed_trial_is_reported_and_takes_no_other_along(done):
    _, trials, outcomes = done
    assert [outcome.trial for outcome in outcomes] == trials
    assert [outcome.summary is None for outcome in outcomes] == [False, False, True]
    assert 'no such trajectory' in outcomes[2].error


def test_trials_that_differ_in_the_map_alone_share_one_bag(done):
    out, _, _ = done
    assert len(list((out / 'bags').iterdir())) == 1
    assert len(list((out / 'trials').iterdir())) == 2


def test_an_interrupted_campaign_continues(done, monkeypatch):
    out, trials, before = done
    # A repeated estimation would fail.
    monkeypatch.setattr('continuum_loc.offline.replay.replay', None)
    again = run_campaign(trials[:2], out, jobs=1)
    assert [one.summary['digest'] for one in again] == [
        one.summary['digest'] for one in before[:2]
    ]


def test_other_settings_are_estimated_anew(done):
    out, trials, before = done
    other = run_campaign(trials[:1], out, settings=EstimatorSettings(window=0.5))
    assert other[0].summary['configuration_digest'] != before[0].summary['configuration_digest']


@pytest.mark.parametrize(
    ('changed', 'renewed'), [('replay_digest', {'trial'}), ('simulation_digest', {'trial', 'bag'})]
)
def test_results_of_other_code_are_not_taken(done, tmp_path, monkeypatch, changed, renewed):
    _, trials, _ = done
    run_campaign(trials[:1], tmp_path)
    files = {
        'trial': tmp_path / 'trials' / trials[0].name / 'summary.json',
        'bag': campaign.bag_of(tmp_path, trials[0]) / 'metadata.yaml',
    }
    before = {name: path.stat().st_mtime_ns for name, path in files.items()}
    monkeypatch.setattr(campaign, changed, lambda *entries: 'of other code')
    run_campaign(trials[:1], tmp_path)
    assert {name for name, path in files.items() if path.stat().st_mtime_ns != before[name]} == (
        renewed
    )


def test_a_robot_that_was_edited_is_recorded_anew(tmp_path):
    from continuum_loc.robot import ROBOTS_FOLDER

    robot = tmp_path / 'mine.yaml'
    text = (ROBOTS_FOLDER / 'soft_arm.yaml').read_text()
    robot.write_text(text)
    trial = Trial(str(robot), 'R0', 'b1', 'R0', plant='soft_arm', seed=3, duration=0.2)
    assert campaign.record_bags([trial], tmp_path) == {}
    bag = campaign.bag_of(tmp_path, trial)
    assert campaign.recorded(bag, trial)
    robot.write_text(text + '\n# measured again\n')
    assert not campaign.recorded(bag, trial)


def test_another_recording_in_the_same_place_is_estimated_anew(done, tmp_path):
    out, trials, _ = done
    bag = campaign.bag_of(tmp_path, trials[0])
    shutil.copytree(campaign.bag_of(out, trials[0]), bag)
    (bag / campaign.MADE_BY).unlink()
    before = campaign.made_by(bag)
    (bag / 'metadata.yaml').write_text((bag / 'metadata.yaml').read_text() + '\n')
    assert campaign.made_by(bag) != before


def test_different_trials_of_one_name_are_refused(tmp_path):
    for folder in ('a', 'b'):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / 'mine.yaml').write_text(folder)
    one, other = (Trial(str(tmp_path / folder / 'mine.yaml')) for folder in ('a', 'b'))
    with pytest.raises(StudyError, match='two different trials are called'):
        run_campaign([one, other], tmp_path)
    with pytest.raises(StudyError, match='recorded as'):
        campaign.record_bags([one, other], tmp_path)


def test_a_recording_that_somebody_put_there_is_taken(done, tmp_path, monkeypatch):
    out, trials, _ = done
    bag = campaign.bag_of(tmp_path, trials[0])
    shutil.copytree(campaign.bag_of(out, trials[0]), bag)
    (bag / campaign.MADE_BY).unlink()
    monkeypatch.setattr(campaign, '_record', None)  # to record it would fail
    assert run_campaign(trials[:1], tmp_path)[0].summary is not None


def test_two_processes_give_what_one_gives(done, tmp_path):
    _, trials, before = done
    again = run_campaign(trials[:2], tmp_path, jobs=2)
    assert [one.summary['digest'] for one in again] == [
        one.summary['digest'] for one in before[:2]
    ]


def test_a_dask_cluster_gives_what_one_process_gives(done, tmp_path):
    distributed = pytest.importorskip('distributed', reason='Dask is an optional extra')
    _, trials, before = done
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        token = parallel.SCHEDULER.set(cluster.scheduler_address)
        try:
            again = run_campaign(trials[:2], tmp_path)
        finally:
            parallel.SCHEDULER.reset(token)
    assert [one.summary['digest'] for one in again] == [
        one.summary['digest'] for one in before[:2]
    ]


def test_a_scheduler_that_is_not_there_is_named(done, tmp_path, monkeypatch):
    pytest.importorskip('distributed', reason='Dask is an optional extra')
    _, trials, _ = done
    monkeypatch.setattr(parallel, 'CONNECT_LIMIT', 1)
    token = parallel.SCHEDULER.set('tcp://127.0.0.1:1')
    try:
        with pytest.raises(StudyError, match=r'no Dask scheduler at tcp://127\.0\.0\.1:1'):
            run_campaign(trials[:1], tmp_path)
    finally:
        parallel.SCHEDULER.reset(token)


def test_a_failure_while_estimating_leaves_its_traceback(done, monkeypatch, tmp_path):
    _, trials, _ = done

    def broken(*arguments):
        raise RuntimeError('solver on fire')

    monkeypatch.setattr(campaign, '_run', broken)
    failed = campaign._estimate(tmp_path, trials[0], None)
    assert failed.error == 'RuntimeError: solver on fire'
    assert 'Traceback' in (tmp_path / 'trials' / trials[0].name / 'error.txt').read_text()


def test_the_soft_arm_campaign_is_the_papers():
    trials = [trial for trial in soft_arm_trials(False, 0) if trial.fidelity == 'paper']
    assert len(trials) == 61
    assert len({trial.recording for trial in trials}) == 23
    assert len({(trial.map_scene, trial.scene) for trial in trials}) == 13
    assert len(table2.trials(False, 0)) == 30


def test_every_condition_has_the_same_trials_and_worlds_are_told_apart():
    """The disturbed world has its own sensors; a claim of it says so."""
    trials = soft_arm_trials(False, 0)
    assert len(trials) == 3 * 61 and len({trial.name for trial in trials}) == 3 * 61
    disturbed = [trial for trial in trials if trial.world == 'disturbed']
    assert len(disturbed) == 61 and {trial.fidelity for trial in disturbed} == {'vl53l5cx'}
    both = in_worlds(table2.trials(True, 0))
    assert [trial.world for trial in both] == ['ideal'] * 2 + ['disturbed'] * 2
    claims = table2.judge([outcome(trial) for trial in both[2:]])
    assert {claim.name for claim in told(claims, 'ideal')} == {claim.name for claim in claims}
    assert all(claim.name.startswith('disturbed: ') for claim in told(claims, 'disturbed'))


def test_no_claim_rests_on_the_hold_out():
    held = replace(HOLD_OUT['engine'], seed=0)
    assert is_hold_out(held)
    with pytest.raises(StudyError, match='tuned on'):
        require_unseen([held])
    # The hold-out is far off here; the claim of S0 must not see it.
    outcomes = [
        outcome(Trial(scene='S0', trajectory='t1', map_scene='S0'), translation=1.0),
        outcome(Trial(scene='S0', trajectory='t2', map_scene='S0')),
    ]
    claims = {claim.name: claim for claim in table2.judge(outcomes)}
    assert claims['S0: translation MAE'].value == pytest.approx(0.15)


def test_a_lost_trial_fails_the_claims_of_its_condition():
    outcomes = [
        outcome(Trial(scene='S0', trajectory='t2', map_scene='S0')),
        Outcome(Trial(scene='S0', trajectory='t3', map_scene='S0'), None, 'boom'),
    ]
    claims = {claim.name: claim for claim in table2.judge(outcomes)}
    assert not claims['S0: translation MAE'].holds
    assert claims['trials that failed'].value == 1
    assert math.isnan(mean(outcomes, 'translation_mae_m'))


def test_a_scene_that_is_16_percent_worse_than_s0_fails():
    base = [outcome(Trial(scene='S0', trajectory=t, map_scene='S0')) for t in ('t2', 't3')]
    worse = [
        outcome(Trial(scene='S8', trajectory=t, map_scene='S0'), translation=0.00116)
        for t in ('t2', 't3')
    ]
    claims = {claim.name: claim for claim in table2.judge(base + worse)}
    assert not claims['S8: translation MAE against S0'].holds
    assert claims['S8: rotation MAE against S0'].holds


def test_a_trial_that_is_off_for_long_and_says_nothing_is_counted():
    trial = Trial('soft_arm', 'R1', 'b2', 'R1')
    assert table3.silently_lost(outcome(trial, silent=1.2))
    assert not table3.silently_lost(outcome(trial, silent=0.4))


def test_tables_show_mean_and_deviation_over_trials_and_rings():
    members = [outcome(Trial(trajectory='t1'), 0.001), outcome(Trial(trajectory='t2'), 0.003)]
    values = 100 * np.array([0.001, 0.002, 0.003, 0.006])
    assert figures(members)['translation MAE [cm]'] == f'{values.mean():.2f} ± {values.std():.2f}'
    rows = condition_table(members, 'scene', lambda one: one.trial.scene, table2.PAPER)
    assert rows[0]['paper: translation MAE [cm]'] == '0.78 ± 0.48'
    assert len(trial_rows([*members, Outcome(Trial(), None, 'boom')])) == 5


def row(name='lookup', ratio=3.0, spread=(2.8, 3.2)):
    return {
        'name': name,
        'ours_s': 1e-6,
        'peer': 'them',
        'peer_s': 3e-6,
        'ratio': ratio,
        'spread': list(spread),
    }


def test_regressions_are_falls_beyond_slack_and_spread(tmp_path):
    baseline = tmp_path / 'baseline.json'
    write_baseline([row()], baseline)

    def regressions(now):
        return BenchOutcome([now], [], []).regressions(baseline)

    assert regressions(row(ratio=1.5, spread=(1.4, 1.6)))
    assert not regressions(row(ratio=2.6, spread=(2.5, 2.7)))  # within the slack
    assert not regressions(row(ratio=1.5, spread=(0.5, 3.0)))  # too noisy to tell
    assert not regressions(row(name='new', ratio=0.1, spread=(0.1, 0.1)))
    with pytest.raises(StudyError, match='no baseline'):
        BenchOutcome([], [], []).regressions(tmp_path / 'nothing.json')


def test_what_has_become_slower_shows_whatever_the_machine_does_meanwhile(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr('bench.harness.process_time', lambda: clock[0])
    noise = np.random.default_rng(0)

    def lasting(seconds):
        def work():  # a busy machine slows down both
            clock[0] += seconds * noise.uniform(1.0, 1.3)

        return work

    def measured(seconds):
        return side_by_side('look', lasting(seconds), 'them', lasting(3e-3), repeats=15)

    baseline = tmp_path / 'baseline.json'
    write_baseline([measured(1e-3)], baseline)
    assert not BenchOutcome([measured(1e-3)], [], []).regressions(baseline)
    lines = BenchOutcome([measured(1.5e-3)], [], []).regressions(baseline)
    assert len(lines) == 1 and 'look against them' in lines[0]


def test_a_partial_baseline_keeps_what_was_not_measured_again(tmp_path):
    baseline = tmp_path / 'baseline.json'
    write_baseline([row('a', 2.0), row('b', 3.0)], baseline)
    write_baseline([row('b', 4.0)], baseline, partial=True)
    assert {key[0]: one['ratio'] for key, one in read_baseline(baseline).items()} == {
        'a': 2.0,
        'b': 4.0,
    }


def test_the_document_takes_each_table_between_its_markers(tmp_path):
    document = tmp_path / 'speed.md'
    document.write_text('Before\n<!-- bench a -->\nold\n<!-- end a -->\nafter\n')
    write_document([row() | {'benchmark': 'a'}], document)
    text = document.read_text()
    assert 'old' not in text and text.startswith('Before\n') and text.endswith('after\n')
    assert '| lookup | 1 us | them | 3 us | 3 | 2.8 to 3.2 |' in text
    assert 'memory' not in text  # nobody has any
    with pytest.raises(StudyError, match='bench b'):
        write_document([row() | {'benchmark': 'b'}], document)


def test_one_broken_benchmark_does_not_stop_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr('bench.harness.BENCH_FOLDER', tmp_path)
    (tmp_path / 'a.py').write_text("def run(quick): raise OSError('no peer')")
    (tmp_path / 'b.py').write_text(
        f"BOUNDS = [('look', 'ratio', 'at least', 5.0)]\ndef run(quick): return [{row()!r}]"
    )
    found = run_bench(tmp_path / 'out', quick=True)
    assert found.failures == [f'a: OSError: no peer ({tmp_path}/out/a.traceback.txt)']
    assert "raise OSError('no peer')" in (tmp_path / 'out' / 'a.traceback.txt').read_text()
    assert [claim.holds for claim in found.claims] == [False]
    assert (
        json.loads((tmp_path / 'out' / 'summary.json').read_text())['failures'] == found.failures
    )
    assert '| lookup |' in (tmp_path / 'out' / 'bench.md').read_text()
    with pytest.raises(StudyError, match='benchmarks: a, b'):
        run_bench(tmp_path / 'out', quick=True, only='c')


def test_bounds_are_judged_on_the_worst_row():
    rows = [row(ratio=2.0), row(ratio=4.0)]
    assert bound_claims(rows, [('lookup', 'ratio', 'at least', 3.0)])[0].value == 2.0
    assert bound_claims(rows, [('lookup', 'ours_s', 'at most', 1e-5)])[0].holds
    assert not bound_claims(rows, [('missing', 'ratio', 'at least', 0.0)])[0].holds


def test_durations_have_a_unit_that_suits_them():
    assert [duration(value) for value in (3e-9, 4.5e-6, 0.02, 3.0, None)] == [
        '3 ns',
        '4.5 us',
        '20 ms',
        '3 s',
        '-',
    ]


def test_tuning_cost_prefers_less_error_and_honest_covariance():
    assert cost(0.001, 0.1, 1.0) < cost(0.0011, 0.1, 1.0)
    assert cost(0.001, 0.1, 1.0) < cost(0.001, 0.1, 2.0)
    assert cost(0.001, 0.1, 2.0) == pytest.approx(cost(0.001, 0.1, 0.5))
    assert cost(float('nan'), 0.1, 1.0) == math.inf


def test_settings_are_scaled_by_name():
    start = EstimatorSettings()
    assert scaled(start, 'tof.floor', 2.0).tof.floor == 2.0 * start.tof.floor
    assert scaled(start, 'prior.strain', 0.5).prior.strain[4] == 0.5 * start.prior.strain[4]
    with pytest.raises(TuneError, match=r"no setting 'tof\.flor'.*tof\.floor"):
        scaled(start, 'tof.flor', 2.0)
    with pytest.raises(SettingsError, match='tof.min_cosine'):
        scaled(start, 'tof.min_cosine', 100.0)
