"""The command line, in a process of its own: exit codes, one-line errors, a light --help."""

import json
import subprocess
import sys

from continuum_loc.errors import StudyError
from continuum_loc.offline.as_json import plain
from continuum_loc.offline.claims import at_least, at_most, between, Claim, write_study
import numpy as np
import pytest
from studies import load_study


def run(*arguments, cwd):
    return subprocess.run(
        [sys.executable, '-m', 'continuum_loc.cli', *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=110,
    )


def test_help_shows_commands_and_examples(tmp_path):
    text = run('--help', cwd=tmp_path).stdout
    for command in ('demo', 'simulate', 'replay', 'map', 'report', 'evaluate', 'bench'):
        assert command in text
        assert command == 'map' or 'Example:' in run(command, '--help', cwd=tmp_path).stdout


def test_help_imports_nothing_heavy(tmp_path):
    code = (
        "import sys, continuum_loc.cli; print([m for m in ('numpy', 'mujoco', 'open3d', 'rclpy', "
        "'matplotlib', 'plotly', 'pandas', 'numba') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.stdout.strip() == '[]', done.stderr


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['simulate', 'bag', '--scene', 'Q7'], "no scene 'Q7'"),
        (['simulate', 'bag', '--robot', 'engin'], "no robot 'engin'"),
        (['simulate', 'bag', '--trajectory', 't9'], "no trajectory 't9'"),
        (['report', '.'], 'no summary.json'),
        (['evaluate', 'tabel2'], "did you mean 'table2'"),
        (['map', 'info', 'nowhere.npz'], 'nowhere.npz'),
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(arguments, said, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith('error: ')
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert 'Traceback' not in done.stderr


def test_wrong_usage_is_exit_code_2(tmp_path):
    assert run('simulate', cwd=tmp_path).returncode == 2
    assert run('demo', '--duration', '0', cwd=tmp_path).returncode == 2
    assert run('nonsense', cwd=tmp_path).returncode == 2


def test_simulate_writes_a_bag_with_truth_and_the_same_seed_the_same_samples(tmp_path):
    from msg_tools.bag import read_bag

    for name in ('a', 'b'):
        done = run(
            'simulate', name, '--duration', '0.3', '--profile', 'live', '--seed', '5', cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
    first, second = (list(read_bag(tmp_path / name)) for name in ('a', 'b'))
    assert {topic for topic, _ in first} >= {
        'tof/points',
        'imu/data_raw',
        'strain',
        'ground_truth/poses',
    }
    assert [(topic, item.stamp) for topic, item in first] == [
        (topic, item.stamp) for topic, item in second
    ]
    frames = [
        [item.ranges.tobytes() for topic, item in bag if topic == 'tof/points']
        for bag in (first, second)
    ]
    assert frames[0] == frames[1]


def test_map_build_convert_and_info(tmp_path):
    from continuum_loc.mapping.map_files import load_map

    assert run('map', 'build', 'R1', 'box.npz', '--spacing', '0.03', cwd=tmp_path).returncode == 0
    assert run('map', 'convert', 'box.npz', 'box.ply', cwd=tmp_path).returncode == 0
    said = run('map', 'info', 'box.ply', cwd=tmp_path)
    built, converted = load_map(tmp_path / 'box.npz'), load_map(tmp_path / 'box.ply')
    assert len(built) == len(converted)
    assert f'{len(built):,} points' in said.stdout


def test_a_scan_in_millimetres_is_told_refused_and_converted(tmp_path):
    from continuum_loc.mapping.map_files import load_map

    rng = np.random.default_rng(0)
    rows = [f'{x:.1f} {y:.1f} 0.0 9 9 9' for x, y in rng.uniform(-1000, 1000, (500, 2))]
    (tmp_path / 'scan.xyz').write_text('\n'.join([*rows, '']))
    said = run('map', 'info', 'scan.xyz', cwd=tmp_path)
    assert said.returncode == 0 and '500 points' in said.stdout
    assert 'left aside: red, green, blue' in said.stdout
    assert 'looks like millimetres' in said.stdout
    refused = run('replay', 'no_bag', '--map', 'scan.xyz', cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.startswith('error: scan.xyz: ') and '--scale 0.001' in refused.stderr
    options = ('--scale', '0.001', '--sigma', '0.002', '--viewpoint', '0', '0', '1')
    assert run('map', 'convert', 'scan.xyz', 'map.npz', *options, cwd=tmp_path).returncode == 0
    prior = load_map(tmp_path / 'map.npz')
    assert np.abs(prior.points).max() == pytest.approx(1.0, abs=0.01)
    assert prior.sigma == 0.002 and prior.oriented
    said = run('map', 'info', 'map.npz', cwd=tmp_path)
    assert 'sigma 2 mm' in said.stdout and 'millimetres' not in said.stdout


def test_names_with_markup_are_printed_as_they_are(tmp_path):
    (tmp_path / '[red]scan.xyz').write_text('0 0 0\n1 0 0\n0 1 0\n')
    assert '[red]scan.xyz: 3 points' in run('map', 'info', '[red]scan.xyz', cwd=tmp_path).stdout


def test_claims_hold_only_inside_their_bounds():
    assert at_most('a', 1.0, 'm', 1.0).holds and not at_most('a', 1.1, 'm', 1.0).holds
    assert at_least('a', 2.0, 'm', 1.0).holds and not at_least('a', 0.9, 'm', 1.0).holds
    assert between('a', 1.0, '', 0.7, 1.5).holds and not between('a', 1.6, '', 0.7, 1.5).holds
    nothing = float('nan')
    assert not any(
        claim.holds
        for claim in (
            at_most('a', nothing, '', 1.0),
            at_least('a', nothing, '', 1.0),
            between('a', nothing, '', 0.0, 1.0),
        )
    )


def test_a_study_writes_claims_versions_seed_and_tables(tmp_path):
    claims = [at_most('error', 0.001, 'm', 0.004), Claim('odd', float('inf'), '-', '-', False)]
    write_study(
        tmp_path, claims, seed=9, settings={'window': 1.0}, tables={'rows': [{'a': 1, 'b': 0.5}]}
    )
    summary = json.loads((tmp_path / 'summary.json').read_text(), parse_constant=pytest.fail)
    assert summary['claims'][0] == {
        'name': 'error',
        'value': 0.001,
        'unit': 'm',
        'bound': '<= 0.004',
        'holds': True,
    }
    assert summary['claims'][1]['value'] is None
    assert summary['seed'] == 9
    assert 'numpy' in summary['versions']
    assert (tmp_path / 'rows.csv').read_text() == 'a,b\n1,0.5\n'


def test_unknown_studies_and_unwritable_values_are_named():
    with pytest.raises(StudyError, match="no study 'nothing'"):
        load_study('nothing')
    with pytest.raises(TypeError, match='cannot write a complex'):
        plain({'x': [1j]})
