"""The filter's studies judge as they say, and faults do what they are called."""

from dataclasses import replace
import json
from pathlib import Path

from continuum_loc.errors import SettingsError, StudyError
from continuum_loc.estimator import EstimatorSettings, load_estimator_settings, SlidingWindowFilter
from continuum_loc.measurements import NANOSECONDS, TofFrame
from continuum_loc.offline.metrics import DOF, Errors, errors
from continuum_loc.offline.replay import replay
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot
from continuum_loc.settings import parse_settings
from continuum_loc.simulator.faults import Dropout, Freeze
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import chi2
from studies import _filter_runs, ablation, consistency, faults
from studies._filter_runs import (
    Case,
    case_samples,
    case_settings,
    CaseResult,
    cut,
    longest_stretch,
    longest_unannounced,
    run_cases,
    settled_since,
    Witness,
)
from studies.support.split import HOLD_OUT, require_unseen
from synthetic import NoisyFilter, samples, START
from worlds import Rod, rod, room_map, stream

flags = st.lists(st.booleans(), min_size=1, max_size=40).map(np.array)


def made_up(error, status, accused=None, shares=None, case=None) -> CaseResult:
    """Make a case of steps at 10 Hz whose rings are off by `error` (K, R) [m]."""
    error = np.asarray(error, float)
    count, rings = error.shape
    times = 0.1 * np.arange(count)
    translation = np.column_stack([np.zeros(count), error])
    found = Errors(
        (times * NANOSECONDS).astype(np.int64),
        ('base', *(f'ring{k + 1}' for k in range(rings))),
        translation,
        translation,
        *(np.zeros((count, rings + 1, 6)),) * 2,
        translation,
    )
    return CaseResult(
        case or Case('made up', Trial()),
        object(),
        '',
        times,
        np.broadcast_to(status, count),
        found,
        times,
        accused or [[]] * count,
        shares or [{}] * count,
    )


# ------------------------------------------------------------------ times


@given(flags)
def test_the_longest_stretch_is_the_longest_run_of_steps(flags):
    times = 0.5 * np.arange(len(flags))
    runs = [len(run) for run in ''.join('x' if flag else ' ' for flag in flags).split()]
    step = 0.5 if len(flags) > 1 else 0.0
    assert longest_stretch(times, flags) == pytest.approx(step * max(runs, default=0))


@given(flags)
def test_settled_is_the_first_time_after_which_nothing_is_wrong(flags):
    times = np.arange(len(flags), dtype=float)
    since = settled_since(times, flags)
    assert np.all(flags[times >= since])
    assert since == 0.0 or not flags[times < since][-1]


def test_a_ring_that_is_off_counts_only_while_the_filter_says_that_it_tracks():
    error = np.full((30, 2), 0.01)
    error[5:20, 1] = 0.06
    assert longest_unannounced(made_up(error, 'tracking')) == pytest.approx(1.5)
    assert longest_unannounced(made_up(error, 'lost')) == 0.0
    assert longest_unannounced(
        made_up(error, np.where(np.arange(30) < 10, 'tracking', 'lost'))
    ) == pytest.approx(0.5)


def test_two_rings_that_are_off_in_turn_are_not_one_that_stays_off():
    error = np.zeros((20, 2))
    error[:10, 0], error[10:, 1] = 0.06, 0.06
    assert longest_unannounced(made_up(error, 'tracking')) == pytest.approx(1.0)


# ------------------------------------------------------------------ cases


@given(st.floats(0.0, 0.4), st.floats(0.05, 0.5))
def test_a_cut_keeps_what_lies_in_its_span_and_no_more(start, length):
    stream_ = list(samples(load_robot('engine'), 0.2))
    kept = list(cut(stream_, start, start + length))
    offsets = [(sample.stamp - START) / NANOSECONDS for sample in stream_]
    assert len(kept) == sum(start - 1e-9 <= offset < start + length - 1e-9 for offset in offsets)


def test_faults_count_their_time_from_where_a_case_starts():
    robot = load_robot('engine')
    case = Case(
        'silent',
        Trial(),
        start=0.5,
        end=1.0,
        faults=(Dropout(sensors=('ring3_*',), start=0.2, end=0.3),),
    )
    kept = [
        s
        for s in case_samples(samples(robot, 1.5), case)
        if getattr(s, 'sensor', '').startswith('ring3_')
    ]
    heard = np.unique([round((s.stamp - START) / NANOSECONDS, 2) for s in kept])
    np.testing.assert_allclose(
        heard, np.concatenate([np.arange(0.5, 0.695, 0.01), np.arange(0.8, 0.995, 0.01)])
    )


def test_a_turned_sensor_keeps_its_ranges_and_sees_its_axis_elsewhere():
    frame = next(s for s in samples(load_robot('engine'), 0.01) if isinstance(s, TofFrame))
    axis = replace(
        frame, points=np.array([[0.5, 0.0, 0.0], [0.3, 0.1, 0.2]]), ranges=frame.ranges[:2]
    )
    turned = next(iter(faults.Turned(angle_deg=20.0)([axis]))).points
    np.testing.assert_allclose(
        np.linalg.norm(turned, axis=1), np.linalg.norm(axis.points, axis=1), rtol=1e-12
    )
    assert np.degrees(np.arccos(turned[0, 0] / 0.5)) == pytest.approx(20.0)


@pytest.mark.parametrize(
    'name', [name for name in ablation.VARIANTS if name not in ('all sensors', 'window 1 s')]
)
def test_every_variant_changes_what_it_names_and_nothing_else(name):
    changes = ablation.VARIANTS[name]
    changed, usual = (
        settings.model_dump()
        for settings in (
            case_settings(Case(name, Trial(), changes)),
            load_estimator_settings('engine'),
        )
    )
    for section in usual:
        wanted = changes.get(section, {})
        if isinstance(wanted, dict) and isinstance(usual[section], dict):
            assert changed[section] == {**usual[section], **wanted}
        else:
            assert changed[section] == wanted or (
                not wanted and changed[section] == usual[section]
            )
    assert changed != usual


def test_a_setting_that_does_not_exist_is_refused_by_name():
    with pytest.raises(SettingsError, match='planarity_powr'):
        case_settings(Case('typo', Trial(), {'tof': {'planarity_powr': 0.0}}))


@pytest.mark.parametrize('quick', [True, False])
def test_no_study_rests_on_the_hold_out_and_no_two_cases_share_a_folder(quick):
    cases = (
        ablation.warm_cases(quick, 0)
        + ablation.cold_cases(quick, 0)
        + faults.fault_cases(quick, 0)
    )
    require_unseen([case.trial for case in cases] + consistency.trials(quick, 0))
    assert len({case.folder for case in cases}) == len(cases)
    with pytest.raises(StudyError):
        require_unseen([HOLD_OUT['engine']])


@pytest.fixture
def recorded(monkeypatch):
    """Synthetic recordings and a filter of known errors; counts how many filters were made."""
    made = []

    def filter_(robot, prior_map, settings):
        if settings.window == 2.0:
            raise RuntimeError('solver on fire')
        made.append(NoisyFilter(robot))
        return made[-1]

    for name, stand_in in (
        ('record_bags', lambda *_: {}),
        ('trial_map_file', lambda trial: Path('map.npz')),
        ('load_map', lambda file: None),
        ('made_by', lambda bag: ''),
        ('make_filter', filter_),
        ('samples_of', lambda bag: samples(load_robot('engine'), 2.0)),
    ):
        monkeypatch.setattr(_filter_runs, name, stand_in)
    return made


def test_a_case_is_replayed_once_and_again_when_its_settings_change(recorded, tmp_path):
    case = Case('one', Trial())
    first = run_cases([case], tmp_path, 1)[0]
    again = run_cases([case], tmp_path, 1)[0]
    assert len(recorded) == 1
    np.testing.assert_array_equal(first.found.pose, again.found.pose)
    run_cases([replace(case, changes={'window': 0.5})], tmp_path, 1)
    run_cases([replace(case, faults=(Freeze(sensors=('tip_tof',)),))], tmp_path, 1)
    assert len(recorded) == 3


def test_a_case_that_fails_is_told_and_takes_no_other_along(recorded, tmp_path):
    good, bad = Case('good', Trial()), Case('bad', Trial(), {'window': 2.0})
    results = run_cases([bad, good], tmp_path, 1)
    assert results[0].error == 'RuntimeError: solver on fire'
    assert results[1].run is not None
    assert _filter_runs.failures(results) == {bad.folder: results[0].error}


# ------------------------------------------------------------------ verdicts


def test_an_ablation_with_a_ring_off_unannounced_fails_its_claim():
    error = np.zeros((30, 5))
    error[:, 4] = 0.08
    claims = ablation.judge([made_up(error, 'tracking', case=Case('without strain', Trial()))], [])
    assert [claim.holds for claim in claims] == [False, True]
    announced = ablation.judge([made_up(error, 'lost', case=Case('without strain', Trial()))], [])
    assert all(claim.holds for claim in announced)


def test_drift_is_the_growth_of_the_error_along_the_body():
    without = made_up(
        np.tile([0.001, 0.002, 0.004, 0.006, 0.010], (30, 1)),
        'tracking',
        case=Case('without ToF', Trial()),
    )
    everything = made_up(np.full((30, 5), 0.001), 'tracking', case=Case('all sensors', Trial()))
    ratios = [
        claim.value for claim in ablation.drift_claims(ablation.by_name([without, everything]))
    ]
    assert ratios == pytest.approx([10.0, 10.0])


EVERYONE = {'ring4_tof2': 0.95, 'tip_tof': 0.9, 'ring1_imu': 1.0}


def fault_case(error, clean_accused=None, **diagnosis) -> dict:
    """Judge a stuck `ring4_tof2` from 1 s to 3 s, beside a clean run that is off by 1 mm."""
    fault = Freeze(sensors=('ring4_tof2',), start=1.0, end=3.0)
    clean = made_up(
        np.full((60, 5), 0.001), 'tracking', accused=clean_accused, shares=[EVERYONE] * 60
    )
    stuck = made_up(error, 'tracking', case=Case('stuck', Trial(), faults=(fault,)), **diagnosis)
    return faults.fault_row(stuck, clean)


def test_back_to_normal_is_timed_from_the_fault_s_end():
    error = np.full((60, 5), 0.001)
    error[10:35] = 0.02
    row = fault_case(error)
    assert row['during [cm]'] == pytest.approx(2.0)
    assert row['back after [s]'] == pytest.approx(0.5)
    error[-1, 2] = 0.02
    assert fault_case(error)['back after [s]'] == np.inf


def test_a_culprit_is_named_as_a_suspect_or_by_its_silence_and_only_in_time():
    error, heard = np.full((60, 5), 0.001), [EVERYONE] * 60
    row = fault_case(
        error, accused=[['ring4_tof2'] if 15 <= k < 20 else [] for k in range(60)], shares=heard
    )
    assert (row['named'], row['named after [s]'], row['accused']) == (1.0, pytest.approx(0.5), 0)
    silent = fault_case(
        error, shares=[{'tip_tof': 0.9} if 20 <= k < 30 else EVERYONE for k in range(60)]
    )
    assert (silent['named'], silent['named after [s]']) == (1.0, pytest.approx(1.0))
    late = fault_case(
        error, accused=[['ring4_tof2'] if k > 45 else [] for k in range(60)], shares=heard
    )
    assert (late['named'], late['named after [s]']) == (0.0, np.inf)
    wrong = fault_case(error, accused=[['tip_tof']] * 60, shares=heard)
    assert (wrong['named'], wrong['accused'], wrong['whom']) == (0.0, 1, 'tip_tof')


def test_who_is_accused_without_the_fault_is_no_finding():
    """
    Neither to the diagnosis' credit nor charged to the fault.

    The former where it is the culprit, the latter where it is another.
    """
    blamed = [['ring4_tof2', 'tip_tof']] * 60
    row = fault_case(
        np.full((60, 5), 0.001), clean_accused=blamed, accused=blamed, shares=[EVERYONE] * 60
    )
    assert (row['named'], row['accused']) == (0.0, 0)
    assert faults.clean_row(
        made_up(np.zeros((60, 5)), 'tracking', accused=blamed, shares=[EVERYONE] * 60)
    ) == {
        'trajectory': 't1',
        'accused': 2,
        'whom': 'ring4_tof2, tip_tof',
        'least share, tof': 0.9,
        'least share, imu': 1.0,
    }


def noisy_errors(overconfidence: float = 1.0) -> Errors:
    """Errors of a filter whose stated sigma is the true one over `overconfidence`."""
    robot = load_robot('engine')
    result = replay(samples(robot, 20.0), NoisyFilter(robot, seed=5))
    track = replace(result.track, covariance=result.track.covariance / overconfidence**2)
    return errors(track, result.truth)


def test_an_honest_filter_passes_and_the_others_do_not():
    """Bounds of the mean of N chi-squares at a false-alarm rate of 0.1 %."""
    found = noisy_errors()
    count = found.nees[:, 1:].size
    low, high = chi2.ppf([0.0005, 0.9995], DOF * count) / (DOF * count)
    known = consistency.honesty(found, slice(1, None))
    assert low < known['NEES/dof'] < high
    assert all(claim.holds for claim in consistency.judge('engine', found)[:2])
    for factor in (1.5, 0.5):
        wrong = noisy_errors(factor)
        assert consistency.honesty(wrong, slice(1, None))['NEES/dof'] == pytest.approx(
            known['NEES/dof'] * factor**2
        )
        assert not any(claim.holds for claim in consistency.judge('engine', wrong)[:2])


def test_components_of_an_honest_filter_have_unit_spread():
    """The root mean square of N unit normals is within 4 / sqrt(2 N) of 1."""
    found = noisy_errors()
    spread = np.array(list(consistency.component_row(found, slice(1, None)).values()))
    assert np.max(np.abs(spread - 1.0)) < 4.0 / np.sqrt(2.0 * found.nees[:, 1:].size)


def test_the_speed_of_turning_is_the_truth_s():
    """Against omega = dR/dt by finite differences, ten times closer than the study's span."""
    robot = load_robot('engine')
    truth = replay(samples(robot, 4.0), NoisyFilter(robot)).truth
    at = START + np.array([1, 2, 3]) * NANOSECONDS
    near = [truth.at(at + side * NANOSECONDS // 100)[..., :3, :3] for side in (-1, 1)]
    cosine = 0.5 * (np.einsum('...ij,...ij->...', *near) - 1.0)
    np.testing.assert_allclose(
        consistency.turning(truth, at), np.arccos(np.minimum(cosine, 1.0)) / 0.02, atol=5e-3
    )


# --------------------------------------------------------- the filter itself, in an analytic world


@pytest.fixture(scope='module')
def room():
    return room_map()


def watched(room, fault=None) -> tuple[CaseResult, Witness]:
    robot = rod()
    settings = parse_settings(EstimatorSettings, {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2})
    witness = Witness(SlidingWindowFilter(robot, room, settings))
    case = Case('analytic', Trial(), faults=() if fault is None else (fault,))
    result = replay(case_samples(stream(Rod(robot), 4.0), case), witness)
    found = errors(result.track, result.truth)
    times = (found.stamps - result.truth.stamps[0]) / NANOSECONDS
    steps = np.array(
        [(entry['stamp'] - result.truth.stamps[0]) / NANOSECONDS for entry in witness.log]
    )
    return CaseResult(
        case,
        object(),
        '',
        times,
        result.track.status[: len(times)],
        found,
        steps,
        [entry['accused'] for entry in witness.log],
        [entry['shares'] for entry in witness.log],
    ), witness


def test_a_healthy_robot_accuses_nobody_and_hears_everybody(room):
    result, witness = watched(room)
    assert not any(result.accused)
    assert set(result.shares[-1]) >= {sensor.name for sensor in rod().tof}
    json.dumps(witness.log)


def test_a_turned_sensor_is_named_alone_and_the_body_stays(room):
    fault = faults.Turned(sensors=('r2_tof1',), start=1.0, end=3.0)
    result, _ = watched(room, fault)
    assert faults.accused(result, fault) == {'r2_tof1'}
    assert result.worst_ring[result.times > 1.0].max() < 0.01


def test_a_silent_ring_is_missed_and_the_body_is_back_within_a_second(room):
    fault = Dropout(sensors=('r1_*',), start=1.0, end=3.0)
    result, _ = watched(room, fault)
    assert all(
        faults.named_at(result, fault, name) < 2.0
        for name in ('r1_tof0', 'r1_tof1', 'r1_tof2', 'r1_imu')
    )
    assert faults.named_at(result, fault, 'r2_tof0') == np.inf
    assert settled_since(result.times, result.worst_ring < 0.005) < 4.0
