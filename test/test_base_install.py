"""What the base gives where nothing else is installed, and what it says of the rest."""

import json
import os
import re
import signal
import subprocess
import sys
import time

from base_install import make
from continuum_loc.extras import EXTRAS, not_installed
from continuum_loc.offline.domain import Domain
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import simulate, Trial, write_bag
from continuum_loc.robot import load_robot
from continuum_loc.simulator.hall_arm import Arm, bent, groove_motion
from msg_tools.bag import read_bag
import numpy as np
import pytest

TRIAL = Trial('soft_arm', 'R0', 'b1', seed=3, duration=1.0)
ARM = load_robot('hall_arm')
HEAVY = {'matplotlib', 'plotly', 'pandas', 'dash', 'sklearn', 'IPython', 'mujoco', 'open3d'}


@pytest.fixture(scope='module')
def base(tmp_path_factory):
    """Make an environment of the base alone, and a folder with bags and a map."""
    folder = tmp_path_factory.mktemp('base')
    write_bag(folder / 'bags' / 'soft', simulate(TRIAL))
    arm = Arm(ARM, seed=1)
    write_bag(folder / 'hall', iter(arm.record(groove_motion(arm, bent(ARM, 6.0)))))
    scene_map('R0').save(folder / 'map.npz')
    return make(folder / 'environment'), folder


def environment(**more):
    keep = ('PATH', 'HOME', 'LANG', 'XDG_CACHE_HOME')
    return {name: os.environ[name] for name in keep if name in os.environ} | more


def ran(python, folder, *arguments):
    return subprocess.run(
        [str(python), *map(str, arguments)],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=280,
    )


@pytest.fixture
def command(base):
    python, folder = base
    return lambda *arguments: ran(python, folder, '-m', 'continuum_loc.cli', *arguments)


def test_nothing_of_the_extras_is_there(base):
    wanted = sorted(HEAVY.union(*EXTRAS.values()) | {'studies', 'bench'})
    code = (
        'from importlib.util import find_spec; import json, continuum_loc\n'
        f'print(json.dumps([one for one in {wanted!r} if find_spec(one)]))\n'
        'print(continuum_loc.__file__)'
    )
    said = ran(*base, '-c', code).stdout.splitlines()
    assert json.loads(said[0]) == []
    assert str(base[1]) in said[1]


def test_every_module_but_those_of_extras_loads(base):
    """Those that need an extra say so by the module that is missing."""
    code = """
import importlib, json, pkgutil, continuum_loc, msg_tools
failed = {}
for package in (continuum_loc, msg_tools):
    for info in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):
        if '.nodes' not in info.name:
            try:
                importlib.import_module(info.name)
            except ModuleNotFoundError as error:
                failed[info.name] = error.name
print(json.dumps(failed))
"""
    done = ran(*base, '-c', code)
    assert done.returncode == 0, done.stderr
    failed = json.loads(done.stdout)
    assert set(failed.values()) <= set().union(*EXTRAS.values())
    rooms = {name.split('.')[1] for name in failed}
    assert rooms <= {'simulator', 'offline'}  # what simulates, and what draws it


def test_recordings_are_replayed_and_the_report_is_left_out(command):
    for arguments in (
        ('replay', 'bags/soft', '--robot', 'soft_arm', '--map', 'map.npz'),
        ('shape', 'hall'),
    ):
        done = command(*arguments)
        assert done.returncode == 0, done.stderr + done.stdout
        assert 'no report: to write reports' in done.stderr
        assert 'pip install plotly jinja2 pandas pillow' in done.stderr
        folder = re.search(r'^run +(\S+)$', done.stdout, re.MULTILINE)[1]
        assert folder.startswith('runs/')


class Graph:
    """Nodes of an installation, as processes in a ROS domain of their own."""

    def __init__(self, python, folder):
        self.python, self.folder, self.domain, self.nodes = python, folder, Domain(), {}

    def start(self, node, ready, **parameters):
        given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
        log = self.folder / f'{node}.log'
        with log.open('w') as stream:
            self.nodes[node] = subprocess.Popen(
                [self.python, '-m', f'continuum_loc.nodes.{node}', '--ros-args', *given],
                cwd=self.folder,
                env=environment(
                    ROS_DOMAIN_ID=str(self.domain.number),
                    ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
                ),
                stdout=stream,
                stderr=subprocess.STDOUT,
                pass_fds=(self.domain.lock,),
            )
        while ready not in log.read_text():
            assert self.nodes[node].poll() is None, log.read_text()
            time.sleep(0.1)

    def stop(self, node):
        self.nodes[node].send_signal(signal.SIGINT)
        assert self.nodes[node].wait(60) == 0, (self.folder / f'{node}.log').read_text()

    def close(self):
        for process in self.nodes.values():
            process.kill()
        self.domain.close()


def true_rings(bag, stamp):
    """(R, 4, 4) poses of base and rings at the stamp of the truth that is nearest."""
    truth = [item for _, item in read_bag(bag, topics=('ground_truth/poses',))]
    return min(truth, key=lambda item: abs(item.stamp - stamp)).T_map_ring


def true_modules(bag, stamp):
    """(M, 4, 4) poses of the modules of the arm in its groove."""
    return ARM.base.T_map_base @ Arm(ARM, seed=1).T_base_module(bent(ARM, 6.0))


@pytest.mark.parametrize(
    ('node', 'bag', 'topic', 'true', 'parameters'),
    [
        ('estimator', 'bags/soft', 'poses', true_rings, {'robot': 'soft_arm', 'map': 'map.npz'}),
        ('shape', 'hall', 'shape/poses', true_modules, {}),
    ],
)
def test_nodes_track_a_bag_where_ros_alone_is_added(
    base, tmp_path, node, bag, topic, true, parameters
):
    """`pip install .[ros]` is all that a robot's own computer needs: within 5 mm of the truth."""
    folder = base[1]
    graph = Graph(make(tmp_path / 'environment', ('ros',)), folder)
    try:
        graph.start('recorder', 'recording', bag=tmp_path / 'recorded')
        graph.start(node, 'ready:', **parameters)
        graph.start('replayer', '', bag=bag, wait_for=2, clock='false')
        assert graph.nodes['replayer'].wait(120) == 0, (folder / 'replayer.log').read_text()
        time.sleep(1.0)  # what came last is still being estimated and written
        for one in (node, 'recorder'):
            graph.stop(one)
    finally:
        graph.close()
    found = [item for _, item in read_bag(tmp_path / 'recorded', topics=(topic,))]
    assert len(found) > 10
    last = found[-1]
    off = last.T_map_body[:, :3, 3] - true(folder / bag, last.stamp)[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 0.005, off


def test_maps_are_read_written_and_converted(command):
    assert command('map', 'convert', 'map.npz', 'map.ply').returncode == 0
    done = command('map', 'info', 'map.ply')
    assert done.returncode == 0 and 'points' in done.stdout


@pytest.mark.parametrize(
    ('arguments', 'extra'),
    [
        (('simulate', 'new_bag'), 'simulate'),
        (('map', 'build', 'S0', 'engine.npz'), 'simulate'),
        (('demo',), 'simulate'),
        (('evaluate', 'bags', 'bags', '--map', 'map.npz', '--robot', 'soft_arm'), 'report'),
    ],
)
def test_what_needs_more_says_in_one_line_what_to_type(command, arguments, extra):
    done = command(*arguments)
    assert done.returncode == 2, done.stderr
    assert str(not_installed(EXTRAS[extra][0], extra)).partition('install ')[2] in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize(
    'arguments', [('evaluate',), ('evaluate', 'table2'), ('bench',), ('import-trial', 'a', 'b')]
)
def test_research_is_said_to_stand_in_the_source_tree(command, arguments):
    done = command(*arguments)
    assert done.returncode == 2
    assert 'stand in the source tree' in done.stderr and '`make install`' in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_ones_own_bags_are_evaluated_without_the_studies(base, tmp_path):
    """In the present environment, which has the extras, with the studies out of reach."""
    _, folder = base
    site = next((folder / 'environment' / 'lib').glob('python3*')) / 'site-packages'
    code = (
        'import sys\n'
        f'sys.path.insert(0, {str(site)!r})\n'
        "sys.modules['studies'] = sys.modules['bench'] = None\n"
        "sys.argv = ['continuum-loc', *sys.argv[1:]]\n"
        'from continuum_loc import cli\n'
        f'assert cli.__file__.startswith({str(folder)!r})\n'
        'cli.main()\n'
    )
    arguments = ('evaluate', 'bags', folder / 'bags', '--map', folder / 'map.npz')
    done = ran(sys.executable, tmp_path, '-c', code, *arguments, '--robot', 'soft_arm')
    assert done.returncode == 0, done.stderr
    assert 'bags that failed' in done.stdout
