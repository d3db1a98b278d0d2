"""
`continuum-loc replay` and its like on bags as people have them.

Exit codes, what is asked for, what is told, and what the report draws.
"""

from dataclasses import replace
import json
import re
import sys

from continuum_loc import cli
from continuum_loc.measurements import ImuSample, StrainSample, TofFrame
from continuum_loc.offline.report import context_of
from continuum_loc.offline.runs import load_run
from continuum_loc.offline.scene_maps import scene_map_file
from continuum_loc.offline.trials import simulate, Trial
from msg_tools.bag import BagWriter
from msg_tools.topics import topic_of
import numpy as np
import pytest
import yaml

ROBOT = 'soft_arm'


@pytest.fixture(scope='module')
def recording():
    return list(simulate(Trial(ROBOT, 'R0', 'b1', seed=3, duration=0.5)))


@pytest.fixture(scope='module')
def prior():
    return scene_map_file('R0')


@pytest.fixture
def command(capsys, tmp_path, monkeypatch):
    """Run a command in this process; its exit code, and what it said on both streams."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, 'argv', ['continuum-loc', *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr()
        return ended.value.code or 0, said.out, said.err

    return run


def written(path, items, namespace=''):
    with BagWriter(path, namespace) as bag:
        for sample in items:
            bag.write(topic_of(sample), sample)
    return path


def test_a_bag_without_a_map_asks_for_one(command, recording, tmp_path):
    """The engine's was taken once, and the estimate was in another place."""
    bag = written(tmp_path / 'bag', recording)
    code, out, error = command('replay', bag, '--robot', ROBOT)
    assert code == 2 and out == ''
    assert re.fullmatch(
        "error: robot 'soft_arm' has ToF sensors, .* `--map FILE`, or `--scene NAME` .*\n", error
    )
    code, _, error = command('tune', 'settings.yaml', '--robot', ROBOT, '--bag', bag)
    assert code == 2 and '--map FILE' in error
    assert not (tmp_path / 'runs').exists()


def test_a_clean_bag_ends_well_and_the_report_draws_the_map_that_was_used(
    command, recording, prior, tmp_path
):
    bag = written(tmp_path / 'bag', recording)
    code, out, error = command('replay', bag, '--robot', ROBOT, '--map', prior)
    assert code == 0, out + error
    assert re.search(r'tof/points (\d+) of \1, imu/data_raw (\d+) of \2', out.replace('\n', ' '))
    assert 'suspects: none' in out and 'covariance: ' in out and 'PROBLEM' not in out
    run = load_run(tmp_path / 'runs' / 'latest')
    assert run.configuration['scene'] is None
    context = context_of(run)
    assert context.mesh is None and len(context.map_points) > 1000
    report = (run.folder / 'report.html').read_text()
    assert 'used of received' in report
    # With a scene of its own the report shows that one.
    code, *_ = command('replay', bag, '--robot', ROBOT, '--scene', 'R0')
    run = load_run(tmp_path / 'runs' / 'latest')
    assert code == 0 and context_of(run).mesh is not None
    assert yaml.safe_load((run.folder / 'configuration.yaml').read_text())['scene'] == 'R0'


def test_a_kind_of_sensor_that_went_unused_is_exit_code_2(command, recording, prior, tmp_path):
    foreign = [
        replace(sample, sensor=f'other_{sample.sensor}')
        if isinstance(sample, TofFrame)
        else sample
        for sample in recording
    ]
    bag = written(tmp_path / 'bag', foreign)
    code, out, _ = command('replay', bag, '--robot', ROBOT, '--map', prior)
    said = out.replace('\n', ' ')
    assert code == 2
    assert re.search(
        r'PROBLEM: none of \d+ tof/points was used: tof/points: robot .soft_arm', said
    )
    summary = json.loads((tmp_path / 'runs' / 'latest' / 'summary.json').read_text())
    assert len(summary['account']['problems']) == 1
    assert (tmp_path / 'runs' / 'latest' / 'report.html').is_file()


def test_one_bad_sample_is_told_and_the_rest_used_unless_strict(
    command, recording, prior, tmp_path
):
    middle = recording[len(recording) // 2].stamp + 1
    strain = StrainSample(middle, np.array([0.1]), np.zeros(1), np.zeros(1))
    bag = written(tmp_path / 'bag', [*recording, strain])
    code, out, _ = command('replay', bag, '--robot', ROBOT, '--map', prior)
    said = out.replace('\n', ' ')
    assert code == 0
    assert "refused 1 as unknown frame: strain: robot 'soft_arm' has no strain sensor" in said
    code, out, error = command('replay', bag, '--robot', ROBOT, '--map', prior, '--strict')
    assert code == 2 and out == ''
    assert re.fullmatch(
        r"error: .*bag: strain: robot 'soft_arm' has no strain sensor \(logged at .*\n", error
    )


def test_several_robots_are_listed_and_one_is_chosen(command, recording, prior, tmp_path):
    from msg_tools.factory import bag_messages, typestore
    from msg_tools.topics import topic_spec
    from rosbags.rosbag2 import StoragePlugin, Writer

    connections, store = {}, typestore()
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for sample in recording:
            topic = topic_of(sample)
            kind = topic_spec(topic).type
            message = topic_spec(topic).encode(bag_messages(), sample)
            for arm in ('left', 'right'):
                name = f'/{arm}/{topic}'
                if name not in connections:
                    connections[name] = writer.add_connection(name, kind, typestore=store)
                data = store.serialize_cdr(message, kind)
                writer.write(connections[name], sample.stamp, data)
    arguments = ('replay', tmp_path / 'bag', '--robot', ROBOT, '--map', prior)
    code, _, error = command(*arguments)
    assert code == 2 and "'left', 'right'" in error and len(error.splitlines()) == 1
    code, out, _ = command(*arguments, '--namespace', 'right')
    assert code == 0 and 'PROBLEM' not in out
    code, _, error = command(*arguments, '--namespace', 'middle')
    assert code == 2 and "no robot 'middle'" in error


def test_a_bag_of_which_nothing_comes_out_is_exit_code_2(command, recording, prior, tmp_path):
    still = [sample for sample in recording if not isinstance(sample, (TofFrame, ImuSample))]
    bag = written(tmp_path / 'bag', still)
    code, out, _ = command('replay', bag, '--robot', ROBOT, '--map', prior)
    assert code == 2 and 'PROBLEM: no estimate: ' in out.replace('\n', ' ')
    code, out, _ = command('shape', written(tmp_path / 'b', recording), '--robot', 'hall_arm')
    assert code == 2 and 'PROBLEM: no estimate: ' in out.replace('\n', ' ')
