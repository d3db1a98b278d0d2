"""Results are tied to the code that made them, and do not hang on how many threads it has."""

import ast
import importlib
from pathlib import Path
import shutil
import subprocess
import sys
import textwrap

import continuum_loc
from continuum_loc.closure import Closure, HOMES, imports_of, PACKAGES
from continuum_loc.offline import source
from continuum_loc.offline.localise import make_filter, trial_settings
from continuum_loc.offline.replay import replay
from continuum_loc.offline.scene_maps import SAMPLER, scene_map
from continuum_loc.offline.trials import simulate, Trial
from continuum_loc.robot import load_robot
import pytest
from studies import _filter_runs
from studies.faults import Turned
from threadpoolctl import threadpool_limits

ROOT = Path(continuum_loc.__file__).parents[1]
# What is stored, by the modules that decide it.
STORED = {
    'recording': source.SIMULATION,
    'replay': source.REPLAY,
    'trial of a study': (*source.REPLAY, 'studies.support.campaign'),
    'case of a study': (*source.REPLAY, 'studies._filter_runs', 'studies._turned'),
    'map': (SAMPLER,),
    'engine scene': ('continuum_loc.simulator.engine_variants',),
    'scene of a mesh': ('continuum_loc.simulator.mesh_import',),
}
STUDY = {'trial of a study', 'case of a study'}
EVERYTHING = {'recording', 'replay'} | STUDY


def digests(root):
    return {what: Closure(entries, root).digest() for what, entries in STORED.items()}


@pytest.fixture(scope='module')
def tree(tmp_path_factory):
    """Copy the code and presets; with the digests of what is stored."""
    root = tmp_path_factory.mktemp('tree')
    for package in PACKAGES:
        shutil.copytree(
            ROOT / package, root / package, ignore=shutil.ignore_patterns('__pycache__')
        )
    return root, digests(root)


@pytest.fixture
def changed(tree):
    """Which digests are others after a file was changed."""
    root, before = tree
    kept = {}

    def of(name, change):
        path = root / name
        kept[path] = path.read_bytes() if path.exists() else None
        path.write_text(change(path.read_text() if path.exists() else ''))
        after = digests(root)
        return {what for what in STORED if after[what] != before[what]}

    yield of
    for path, content in kept.items():
        path.unlink() if content is None else path.write_bytes(content)


def with_one_more(text):
    return text + '\nONE_MORE = 1\n'


@pytest.mark.parametrize(
    ('name', 'stale'),
    [
        ('continuum_loc/magnet.py', EVERYTHING),
        ('continuum_loc/robot.py', EVERYTHING),
        ('msg_tools/convert.py', EVERYTHING),
        ('continuum_loc/estimator/factors/tof.py', {'replay'} | STUDY),
        ('continuum_loc/mapping/build.py', {'map', 'replay'} | STUDY),
        ('continuum_loc/formats/stl.py', {'scene of a mesh'} | EVERYTHING),
        ('continuum_loc/simulator/world.py', {'recording'} | STUDY),
        ('continuum_loc/simulator/cutting.py', {'recording', 'scene of a mesh'} | STUDY),
        ('continuum_loc/simulator/solids.py', {'recording', 'engine scene', 'scene of a mesh'}),
        ('studies/_turned.py', {'case of a study'}),
        ('studies/support/campaign.py', STUDY),
    ],
)
def test_a_change_of_code_makes_stale_what_it_decides(changed, name, stale):
    found = changed(name, with_one_more)
    assert stale <= found
    # What a study stores hangs on all that it calls; each of the others on its own part alone.
    assert found - STUDY == stale - STUDY


@pytest.mark.parametrize(
    ('name', 'stale'),
    [
        ('continuum_loc/estimator/presets/engine.yaml', {'replay'} | STUDY),
        ('continuum_loc/estimator/presets/new_robot.yaml', {'replay'} | STUDY),
        ('continuum_loc/simulator/plants/engine.yaml', {'recording'} | STUDY),
        ('continuum_loc/robots/engine.yaml', EVERYTHING),
    ],
)
def test_a_change_of_a_preset_makes_stale_what_reads_it(changed, name, stale):
    found = changed(name, lambda text: text + '\n# one more\n')
    # Maps and scenes are not made from presets: their names leave those out.
    assert found & EVERYTHING == stale


@pytest.mark.parametrize(
    'name',
    [
        'continuum_loc/offline/figures.py',
        'continuum_loc/offline/report.py',
        'continuum_loc/offline/tables.py',
        'continuum_loc/offline/study_report.py',
        'continuum_loc/offline/error_tables.py',
        'continuum_loc/offline/templates/report.html.j2',
        'continuum_loc/nodes/estimator.py',
        'continuum_loc/cli.py',
        'continuum_loc/scene/fuse.py',
        'studies/_pages.py',
        'studies/_anomaly_report.py',
        'studies/table2.py',
        'bench/lookup.py',
    ],
)
def test_a_change_of_a_figure_or_a_report_makes_nothing_stale(changed, name):
    assert changed(name, with_one_more) == set()


@pytest.mark.parametrize(
    'change',
    [
        lambda text: '# a comment\n' + text,
        lambda text: text.replace('return', 'return  '),
        lambda text: text.replace('"""', '"""In other words: ', 1),
    ],
)
def test_words_and_layout_make_nothing_stale(changed, change):
    assert changed('continuum_loc/magnet.py', change) == set()


def test_a_case_hangs_on_the_module_of_its_fault():
    trial = Trial()
    plain = _filter_runs.code_of(_filter_runs.Case('plain', trial))
    turned = _filter_runs.code_of(_filter_runs.Case('turned', trial, faults=(Turned(),)))
    assert plain == source.replay_digest('studies._filter_runs')
    assert turned == source.replay_digest('studies._filter_runs', 'studies._turned')
    assert plain != turned


# ------------------------------------------------------------------ what is found


SIMULATE = """
from continuum_loc.offline.trials import simulate, Trial, write_bag
trial = Trial('soft_arm', 'R0', 'b1', fidelity='vl53l5cx', disturbed=True, duration=0.4)
write_bag(Path('bag'), simulate(trial))
"""
REPLAY = """
from continuum_loc.mapping.map_files import load_map
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.replay import replay
from continuum_loc.offline.runs import save_run
from continuum_loc.robot import load_robot
result = replay('bag', make_filter(load_robot('soft_arm'), load_map('map.npz')))
save_run(Path('run'), result, kind='trial', seed=0, configuration={})
"""
LOADED = """
import sys
for name in list(sys.modules):
    if name.partition('.')[0] in ('continuum_loc', 'msg_tools'):
        print(name)
"""


def test_all_that_a_trial_loads_is_in_its_closure(tmp_path):
    scene_map('R0').save(tmp_path / 'map.npz')
    for program, entries in ((SIMULATE, source.SIMULATION), (REPLAY, source.REPLAY)):
        done = subprocess.run(
            [sys.executable, '-c', 'from pathlib import Path\n' + program + LOADED],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={'PYTHONPATH': str(ROOT), 'HOME': str(Path.home())},
        )
        assert done.returncode == 0, done.stderr
        loaded = set(done.stdout.split())
        assert len(loaded) > 20
        assert loaded - set(Closure(entries).modules) == set()


def test_no_module_of_a_closure_imports_by_a_name_that_it_computes():
    """But lazy packages, whose table of homes is read, and ROS's own messages."""
    modules = Closure([one for entries in STORED.values() for one in entries]).modules
    dynamic = {
        name
        for name, path in modules.items()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func).endswith(('import_module', '__import__'))
    }
    lazy = {name for name, path in modules.items() if f'{HOMES} = ' in path.read_text()}
    # `studies` loads the study that is asked for by name, which no stored result does; `extras`
    # loads what `require` names, which is read as an import.
    assert dynamic - lazy == {'msg_tools.factory', 'studies', 'continuum_loc.extras'}
    assert lazy == {'continuum_loc.estimator', 'continuum_loc.simulator', 'msg_tools'}
    for package in map(importlib.import_module, lazy):
        assert all(getattr(package, name) for name in vars(package)[HOMES])


def small(tmp_path, **files):
    """Make a package `bench` of files by name, with `__` for `/`."""
    (tmp_path / 'bench').mkdir()
    (tmp_path / 'bench' / '__init__.py').write_text('')
    for name, text in files.items():
        path = tmp_path / 'bench' / (name.replace('__', '/') + '.py')
        path.parent.mkdir(exist_ok=True)
        path.write_text(textwrap.dedent(text))
    return tmp_path


def reached(root, *entries):
    return {name.removeprefix('bench.') for name in Closure(entries, root).modules} - {'bench'}


def test_imports_count_wherever_they_stand_but_for_those_of_types(tmp_path):
    root = small(
        tmp_path,
        entry="""
            from typing import TYPE_CHECKING
            from bench import above
            if TYPE_CHECKING:
                import bench.types_only
            else:
                from . import otherwise
            def f():
                import bench.inside
            class A:
                from .sub import deeper
            """,
        above='import bench.further\n',
        further='import entry\n',  # of no package of ours
        types_only='',
        otherwise='',
        inside='import bench.entry\n',
        sub__deeper='from bench.sub import *\n',
        unrelated='',
    )
    (root / 'bench' / 'sub' / '__init__.py').write_text('from ..further import x\n')
    assert reached(root, 'bench.entry') == {
        'entry',
        'above',
        'further',
        'otherwise',
        'inside',
        'sub',
        'sub.deeper',
    }
    assert 'entry' in Closure(['bench.entry'], root).libraries
    with pytest.raises(ModuleNotFoundError, match=r'no module bench\.nothing'):
        Closure(['bench.nothing'], root)


def test_a_lazy_package_brings_the_homes_that_are_asked_for(tmp_path):
    root = small(
        tmp_path,
        one='from bench.lazy import A\n',
        all='from bench import lazy\n',
        star='from bench.lazy import *\n',
        lazy__a='',
        lazy__b='',
    )
    (root / 'bench' / 'lazy' / '__init__.py').write_text(f"{HOMES} = {{'A': 'a', 'B': 'b'}}\n")
    assert reached(root, 'bench.one') == {'one', 'lazy', 'lazy.a'}
    assert reached(root, 'bench.all') == {'all', 'lazy', 'lazy.a', 'lazy.b'}
    assert reached(root, 'bench.star') == {'star', 'lazy', 'lazy.a', 'lazy.b'}


def test_presets_belong_to_the_room_that_they_lie_in(tmp_path):
    root = small(tmp_path, entry='', other__a='')
    (root / 'bench' / 'other' / '__init__.py').write_text('')
    for folder in ('presets', 'other/presets'):
        (root / 'bench' / folder).mkdir()
        (root / 'bench' / folder / 'x.yaml').write_text('')

    def presets(*entries):
        files = Closure(entries, root).files()
        return [path.parent.relative_to(root).as_posix() for path in files if path.suffix != '.py']

    assert presets('bench.entry') == ['bench/presets']
    assert presets('bench.other.a') == ['bench/other/presets', 'bench/presets']
    assert Closure(['bench.other.a'], root).files(presets=False) == sorted(
        root / 'bench' / name for name in ('__init__.py', 'other/__init__.py', 'other/a.py')
    )


def test_another_version_of_a_library_is_other_code(tmp_path, monkeypatch):
    root = small(tmp_path, entry='import numpy, json\n')
    before = Closure(['bench.entry'], root).digest()
    monkeypatch.setattr('importlib.metadata.version', lambda name: 'another')
    assert Closure(['bench.entry'], root).digest() != before


def test_an_import_of_several_names_is_several(tmp_path):
    path = tmp_path / 'a.py'
    path.write_text(
        'import x.y, z\nfrom . import b, c\nfrom ..d import e as f\ng = require("h.i", "maps")\n'
    )
    found = [(one.module, one.name) for one in imports_of(path, 'p.q.a')]
    assert found == [('x.y', ''), ('z', ''), ('p.q', 'b'), ('p.q', 'c'), ('p.d', 'e'), ('h.i', '')]


def test_a_replay_does_not_hang_on_the_number_of_threads():
    # Two threads gave another last bit from the 39th estimate of this recording on.
    trial = Trial(
        'soft_arm', 'R1', 'b2', 'R0', fidelity='vl53l5cx', disturbed=True, seed=0, duration=3.0
    )
    samples = list(simulate(trial))
    digests = set()
    for threads in (1, 2):
        with threadpool_limits(threads):
            estimator = make_filter(
                load_robot(trial.robot), scene_map(trial.map_scene), trial_settings(trial)
            )
            digests.add(replay(iter(samples), estimator).digest)
    assert len(digests) == 1
