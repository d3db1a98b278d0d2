"""Recordings of one's own: each gives results or says why not, and takes no other along."""

import json
import re
import shutil

from continuum_loc.errors import BagError, MapError
from continuum_loc.estimator.settings import settings_of
from continuum_loc.measurements import TruthSample
from continuum_loc.offline import bags
from continuum_loc.offline.bags import bag_trials, evaluate_bags
from continuum_loc.offline.scene_maps import scene_map_file
from continuum_loc.offline.trials import simulate, Trial, write_bag
from continuum_loc.robot import load_robot
import pytest

ROBOT = 'soft_arm'


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp('recordings')
    samples = list(simulate(Trial(ROBOT, 'R0', 'b1', seed=3, duration=0.4)))
    write_bag(folder / 'whole', iter(samples))
    write_bag(folder / 'without_truth', (s for s in samples if not isinstance(s, TruthSample)))
    write_bag(folder / 'truth_alone', (s for s in samples if isinstance(s, TruthSample)))
    shutil.copytree(folder / 'whole', folder / 'cut_off')
    for file in (folder / 'cut_off').glob('*.mcap'):
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return folder


def evaluate(folder, out, robot=ROBOT):
    return evaluate_bags(folder, load_robot(robot), scene_map_file('R0'), settings_of(robot), out)


@pytest.fixture(scope='module')
def evaluated(recordings, tmp_path_factory):
    out = tmp_path_factory.mktemp('evaluated')
    claims = evaluate(recordings, out)
    return out, claims, json.loads((out / 'summary.json').read_text())


def rows(out, name):
    return {row['bag']: row for row in json.loads((out / f'{name}.json').read_text())}


def test_bags_that_give_nothing_say_why_and_take_no_other_along(evaluated):
    out, claims, summary = evaluated
    assert [(claim.value, claim.holds) for claim in claims] == [(2, False)]
    assert set(summary['failed']) == {'cut_off', 'truth_alone'}
    assert 'mcap recover' in summary['failed']['cut_off']
    assert 'no estimate: no measurement in it' in summary['failed']['truth_alone']
    found = rows(out, 'bags')
    assert (found['whole']['failed'], found['whole']['judged'] > 0) == (0, True)
    assert found['all']['failed'] == 2


def test_a_bag_without_truth_has_estimates_and_no_errors(evaluated):
    out, _, _ = evaluated
    row = rows(out, 'bags')['without_truth']
    assert row['estimates'] > 0
    assert (row['judged'], row['failed'], row['translation MAE [cm]']) == (0, 0, '-')
    assert rows(out, 'rings')['without_truth']['translation_mae_m'] is None
    worst_first = (out / 'report.html').read_text().partition('Worst trials first')[2]
    cells = re.findall('<td[^>]*>([^<]*)</td>', worst_first)
    assert cells[:10:5] == ['whole', 'without_truth']
    assert cells[6:9] == ['–'] * 3


def test_what_was_replayed_already_is_taken_as_it_is(evaluated, recordings, monkeypatch):
    out, _, before = evaluated
    monkeypatch.setattr(bags, 'replay', None)  # to replay would fail
    evaluate(recordings, out)
    again = json.loads((out / 'summary.json').read_text())
    assert set(again['failed']) == set(before['failed'])


def test_a_bag_that_has_changed_is_replayed_anew(recordings, tmp_path):
    folder, out = tmp_path / 'bags', tmp_path / 'out'
    folder.mkdir()
    shutil.copytree(recordings / 'whole', folder / 'one')
    evaluate(folder, out)
    shutil.rmtree(folder / 'one')
    shutil.copytree(recordings / 'without_truth', folder / 'one')
    evaluate(folder, out)
    assert rows(out, 'bags')['one']['judged'] == 0


def test_another_robots_bag_is_named(recordings, tmp_path):
    (tmp_path / 'bags').mkdir()
    shutil.copytree(recordings / 'whole', tmp_path / 'bags' / 'one')
    evaluate(tmp_path / 'bags', tmp_path / 'out', robot='engine')
    error = json.loads((tmp_path / 'out' / 'summary.json').read_text())['failed']['one']
    assert 'holds 4 poses; this robot has 6' in error


def test_bags_of_one_name_are_told_apart_and_hidden_ones_passed_by(recordings, tmp_path):
    for name in ('a', 'b', '.half'):
        shutil.copytree(recordings / 'whole', tmp_path / name)
    shutil.copy(next((recordings / 'whole').glob('*.mcap')), tmp_path / 'a.mcap')
    assert [trial.name for trial in bag_trials(tmp_path)] == ['a', 'a.mcap', 'b']


def test_a_folder_or_map_that_is_not_there_ends_it_before_any_work(recordings, tmp_path):
    with pytest.raises(BagError, match='no such folder'):
        evaluate(tmp_path / 'none', tmp_path / 'out')
    with pytest.raises(BagError, match='no bags in it'):
        evaluate(tmp_path, tmp_path / 'out')
    with pytest.raises(MapError, match='no such file'):
        evaluate_bags(
            recordings,
            load_robot(ROBOT),
            tmp_path / 'none.npz',
            settings_of(ROBOT),
            tmp_path / 'out',
        )
    assert not (tmp_path / 'out').exists()
