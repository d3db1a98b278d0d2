"""The package as such: light and free of ROS at its core, and what colcon and pip need of it."""

import ast
import io
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tokenize
import tomllib
import xml.etree.ElementTree as ElementTree

from continuum_loc import start
from continuum_loc.closure import imports_of
from continuum_loc.errors import NotInstalled
from continuum_loc.extras import BASE, EXTRAS, not_installed, require_base, WHAT
import pytest

ROOT = Path(__file__).resolve().parent.parent
ROS = (
    'rclpy',
    'rcl_interfaces',
    'sensor_msgs',
    'geometry_msgs',
    'nav_msgs',
    'std_msgs',
    'std_srvs',
    'diagnostic_msgs',
    'builtin_interfaces',
    'visualization_msgs',
    'rosgraph_msgs',
    'tf2_msgs',
    'tf2_ros',
    'launch',
    'launch_ros',
)
HEAVY = ('open3d', 'mujoco', 'trimesh', 'matplotlib', 'plotly', 'pandas', 'rosbags')
NODES = ('simulator', 'estimator', 'shape', 'recorder', 'replayer', 'driver', 'viewer')


def _modules(skip=('nodes',)):
    for package in ('continuum_loc', 'msg_tools'):
        for path in sorted((ROOT / package).rglob('*.py')):
            parts = path.relative_to(ROOT).with_suffix('').parts
            if not set(parts) & set(skip):
                yield '.'.join(parts[:-1] if parts[-1] == '__init__' else parts), path


def _python(code, **environment):
    return subprocess.run(
        [sys.executable, '-c', code],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | environment,
        cwd=ROOT,
    )


def test_the_core_imports_without_ros():
    """Every module outside nodes/ loads in a Python where ROS cannot be imported."""
    names = [name for name, _ in _modules()]
    code = (
        f'import sys\nfor name in {ROS!r}: sys.modules[name] = None\n'
        f'import importlib\nfor name in {names!r}: importlib.import_module(name)\n'
    )
    done = _python(code)
    assert done.returncode == 0, done.stderr


def test_importing_the_package_is_light():
    code = (
        'import sys, continuum_loc, msg_tools, continuum_loc.robot, continuum_loc.measurements\n'
        'import continuum_loc.offline.live\n'
        f'print([name for name in {ROS + HEAVY!r} if name in sys.modules])'
    )
    assert _python(code).stdout.strip() == '[]'


def test_only_nodes_and_launch_files_know_ros():
    for name, path in _modules(skip=('nodes',)):
        imported = {
            alias.name.split('.')[0]
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import)
            for alias in node.names
        }
        imported |= {
            node.module.split('.')[0]
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module and node.level == 0
        }
        assert not imported & set(ROS), f'{name} imports {imported & set(ROS)}'


def test_nothing_outside_launch_files_needs_what_has_no_wheel():
    absent = {
        'sensor_msgs_py',
        'tf2_ros',
        'tf2_msgs',
        'launch',
        'launch_ros',
        'rosbag2_py',
        'message_filters',
        'diagnostic_updater',
    }
    for name, path in _modules(skip=()):
        for node in ast.walk(ast.parse(path.read_text())):
            module = node.module if isinstance(node, ast.ImportFrom) else None
            modules = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [module or '']
            )
            assert not {m.split('.')[0] for m in modules} & absent, f'{name} imports {modules}'


def test_package_xml_is_what_colcon_takes_for_ament_python():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert package.findtext('name') == 'continuum_loc'
    assert package.findtext('export/build_type') == 'ament_python'
    # An invalid address makes colcon take the package for plain Python, without a word:
    # catkin_pkg's own rule.
    assert re.match(
        r'^[a-zA-Z0-9._%+-]+@[a-zA-Z0-9._%+-]+\.[a-zA-Z]{2,6}$',
        package.find('maintainer').get('email'),
    )
    version = re.search(r'version=.([\d.]+).', (ROOT / 'setup.py').read_text())[1]
    assert package.findtext('version') == version
    assert (ROOT / 'resource' / 'continuum_loc').is_file()


def _imported(*packages):
    """Names of the modules of others that our packages import, wherever in them."""
    own = {'continuum_loc', 'msg_tools', 'studies', 'bench'}
    later = {'compression'}  # in Python's own library from 3.14 on
    found = {
        imported.module.partition('.')[0]
        for package in packages
        for path in (ROOT / package).rglob('*.py')
        for imported in imports_of(path, '.'.join(path.relative_to(ROOT).with_suffix('').parts))
    }
    return found - set(sys.stdlib_module_names) - own - later


def _setup():
    """List the distributions that are required, by extra ('' for the base)."""
    call = next(
        node
        for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == 'setup'
    )
    given = {
        keyword.arg: ast.literal_eval(keyword.value)
        for keyword in call.keywords
        if keyword.arg in ('install_requires', 'extras_require')
    }
    lines = {'': given['install_requires'], **given['extras_require']}
    return {
        extra: {re.split(r'[<>=\[;]', one)[0] for one in all_} for extra, all_ in lines.items()
    }


MODULES = {
    'backports.zstd': 'backports',
    'pyyaml': 'yaml',
    'pillow': 'PIL',
    'ros-jazzy-rclpy': 'rclpy',
}
NO_MODULE = {'ros-common-interfaces', 'dask', 'continuum_loc'}  # messages; part of distributed; us


def test_setup_py_names_all_that_the_package_imports_and_nothing_else():
    setup = _setup()
    modules = {
        extra: {MODULES.get(one, one) for one in names - NO_MODULE}
        for extra, names in setup.items()
        if extra not in ('test', 'bench', 'all')
    }
    named = set().union(*modules.values())
    imported = _imported('continuum_loc', 'msg_tools')
    assert imported - set(ROS) <= named
    assert named - imported == {'matplotlib', 'psutil'}  # of the studies alone
    assert _imported('studies') <= named | {'numpy'}
    assert modules[''] <= imported


def _oldest():
    """Return the oldest version that setup.py allows, by distribution, of those that have one."""
    call = next(
        node
        for node in ast.walk(ast.parse((ROOT / 'setup.py').read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == 'setup'
    )
    given = {keyword.arg: keyword.value for keyword in call.keywords}
    lines = ast.literal_eval(given['install_requires']) + sum(
        ast.literal_eval(given['extras_require']).values(), []
    )
    return dict(re.match(r'([\w.-]+)>=([\d.]+)$', line).groups() for line in lines if '>=' in line)


def test_what_is_told_to_be_installed_is_what_setup_py_has():
    setup = _setup()
    assert set(EXTRAS) == set(WHAT) == set(setup) - {'', 'all', 'test', 'bench'}
    for extra, modules in EXTRAS.items():
        named = {MODULES.get(one, one) for one in setup[extra] - NO_MODULE - setup['']}
        assert set(modules) == named, extra
        assert not set(modules) & setup['']
        told = str(not_installed(modules[0], extra)).split('pip install ')[1]
        for one in setup[extra] - {'dask', 'continuum_loc'}:  # brought by others, and ourselves
            assert one in told, extra
    assert set(BASE) == setup[''] - {'llvmlite', 'lz4', 'backports.zstd'}  # which others bring
    assert {name: _oldest()[name] for name in BASE} == BASE


def test_the_oldest_versions_allowed_are_those_that_are_tested():
    """`make test-noble` runs the suite in the environment of requirements-noble.txt."""
    tested = {}
    for line in (ROOT / 'requirements-noble.txt').read_text().splitlines():
        if line and line[0] != '#':
            name, version = re.match(r'([\w.-]+)(?:\[\w+\])?==([\w.]+)', line).groups()
            tested[name.lower()] = min(version, tested.get(name.lower(), version))
    for name, version in _oldest().items():
        assert f'{tested[name]}.'.startswith(f'{version}.'), (name, version, tested[name])


KEYS = {
    'python3-numba': {'numba', 'llvmlite'},
    'python3-pil': {'PIL'},
    'python3-venv': set(),  # for what pip has to bring
    'ros2launch': {'launch', 'launch_ros'},
}
BROUGHT = {'rosbags': {'rosbags', 'lz4', 'backports'}}


def test_package_xml_names_all_that_the_package_imports():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    named = {one.text: one.get('condition') for one in package.findall('exec_depend')}
    assert not [key for key in named if key.endswith('-pip')]  # Ubuntu 24.04 refuses them
    modules = {key: KEYS.get(key, {re.sub('^python3-', '', key)}) for key in named}
    by_pip = {one.text: one.get('extra', '') for one in package.findall('export/pip')}
    everything = set().union(*modules.values(), *(BROUGHT.get(one, {one}) for one in by_pip))
    messages = {
        match
        for folder in ('continuum_loc', 'msg_tools')
        for path in (ROOT / folder).rglob('*.py')
        for match in re.findall(r"'(\w+)/(?:msg|srv)/", path.read_text())
    }
    imported = _imported('continuum_loc', 'msg_tools', 'launch', 'studies')
    assert imported | messages == everything
    # What the base does not need is not installed without being asked for.
    base = {MODULES.get(one, one) for one in _setup()['']} | set(ROS)
    for key, condition in named.items():
        assert (condition is None) == (modules[key] <= base), key
    for module, extra in by_pip.items():
        assert module in _setup()[extra]


def test_package_xml_asks_for_the_versions_of_setup_py():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    asked = {
        re.sub('^python3-', '', one.text).replace('yaml', 'pyyaml'): one.get('version_gte')
        for one in package.findall('exec_depend') + package.findall('export/pip')
        if one.get('version_gte')
    }
    assert asked == BASE
    for_pip = {
        one.text: one.get('version_gte')
        for one in package.findall('export/pip')
        if not one.get('extra')
    }
    lines = (ROOT / 'requirements-jazzy.txt').read_text().splitlines()
    assert {f'{name}>={version}' for name, version in for_pip.items()} == {
        line for line in lines if line[0] != '#'
    }


def test_pyproject_leaves_the_metadata_to_setup_py():
    assert 'project' not in tomllib.loads((ROOT / 'pyproject.toml').read_text())


def test_every_node_has_its_executable_where_ros2_run_looks():
    for node in NODES:
        path = ROOT / 'resource' / 'executables' / node
        assert os.access(path, os.X_OK) and path.read_text().startswith('#!/bin/sh')
        assert (ROOT / 'continuum_loc' / 'nodes' / f'{node}.py').is_file()
        assert (ROOT / 'config' / f'{node}.yaml').is_file()


@pytest.mark.parametrize('command', ['check', 'format --check'])
def test_the_style_is_that_of_ros(command):
    """Rules of ament_flake8 and ament_pep257, as pyproject.toml has them."""
    done = subprocess.run(
        [sys.executable, '-m', 'ruff', *command.split(), '.'],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout


def test_arrows_run_downward_and_there_are_no_circles():
    """As the contracts of import-linter in pyproject.toml have it."""
    done = subprocess.run(
        [Path(sys.executable).with_name('lint-imports'), '--no-cache'],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert '2 kept' in done.stdout


def test_every_room_has_its_floor():
    layers = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['importlinter'][
        'contracts'
    ][0]['layers']
    named = {name.strip() for layer in layers for name in re.split('[|:]', layer)}
    rooms = {
        f'continuum_loc.{path.stem}'
        for path in (ROOT / 'continuum_loc').iterdir()
        if (path.suffix == '.py' and path.stem != '__init__') or (path / '__init__.py').is_file()
    }
    assert named == rooms | {'msg_tools', 'studies', 'bench'}


def test_no_slice_has_a_space_before_its_colon():
    """E203 of ament_flake8, which ruff's formatter breaks: give bounds that need one a name."""
    spaced = []
    for folder in ('continuum_loc', 'msg_tools', 'studies', 'test', 'bench', 'launch'):
        for path in (ROOT / folder).rglob('*.py'):
            text = path.read_text()
            if not re.search('[^ ,] +:', text):
                continue
            for token in tokenize.generate_tokens(io.StringIO(text).readline):
                before = token.line[: token.start[1]]
                if token.string == ':' and re.search('[^ ,] +$', before):
                    spaced.append(f'{path.relative_to(ROOT)}:{token.start[0]}')
    assert not spaced


def test_requirements_are_pinned_and_name_no_index():
    lines = [
        line
        for line in (ROOT / 'requirements.txt').read_text().splitlines()
        if line and line[0] != '#'
    ]
    assert all(re.fullmatch(r'[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+( ?;.*)?', line) for line in lines)


@pytest.mark.timeout(300)
def test_a_wheel_holds_everything_that_runs(tmp_path):
    """Built from a copy of the tracked files: data, executables and entry points are in it."""
    import zipfile

    files = subprocess.run(
        ['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True
    ).stdout.split()
    if not files:
        pytest.skip('not a git checkout')
    for name in files:
        if (ROOT / name).is_file() and not name.startswith('test/'):
            (tmp_path / 'src' / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tmp_path / 'src' / name)
    build = 'pip wheel --quiet --no-deps --no-build-isolation --wheel-dir'.split()
    done = subprocess.run(
        [sys.executable, '-m', *build, str(tmp_path), str(tmp_path / 'src')],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    inside = zipfile.ZipFile(next(tmp_path.glob('*.whl'))).namelist()
    data = [name.split('.data/data/')[1] for name in inside if '.data/data/' in name]
    assert {f'lib/continuum_loc/{node}' for node in NODES} <= set(data)
    assert {f'share/continuum_loc/config/{node}.yaml' for node in NODES} <= set(data)
    assert {
        'share/ament_index/resource_index/packages/continuum_loc',
        'share/continuum_loc/package.xml',
    } <= set(data)
    packaged = {str(path.relative_to(ROOT)) for path in (ROOT / 'continuum_loc').rglob('*.yaml')}
    assert packaged & set(files) <= set(inside)


def test_what_is_missing_or_too_old_is_told_in_one_line(tmp_path):
    """Pydantic 1 as Ubuntu 24.04 has it, and a library that is not there at all."""
    old = tmp_path / 'pydantic-1.10.14.dist-info'
    old.mkdir()
    (old / 'METADATA').write_text('Metadata-Version: 2.1\nName: pydantic\nVersion: 1.10.14\n')
    done = subprocess.run(
        [
            sys.executable,
            '-c',
            'import sys; from continuum_loc import extras, start\n'
            "extras.BASE['no-such-thing'] = '3.0'; start.estimator()",
        ],
        capture_output=True,
        text=True,
        env=os.environ | {'PYTHONPATH': f'{tmp_path}:{ROOT}'},
        timeout=60,
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert 'pydantic 2.4.2 or newer (1.10.14 is installed)' in line
    assert 'no-such-thing 3.0 or newer (not installed)' in line
    assert line.endswith("pip install 'pydantic>=2.4.2' 'no-such-thing>=3.0'")


def test_where_pip_refuses_the_system_s_python_an_environment_is_made_first(monkeypatch, tmp_path):
    (tmp_path / 'EXTERNALLY-MANAGED').touch()
    monkeypatch.setattr('sysconfig.get_path', lambda name: str(tmp_path))
    monkeypatch.setattr(sys, 'base_prefix', sys.prefix)
    with pytest.raises(NotInstalled, match='venv --system-site-packages .venv && . .venv/bin/'):
        require_base({'no-such-thing': '1.0'})
    monkeypatch.setattr(sys, 'base_prefix', '/usr')  # in an environment
    with pytest.raises(NotInstalled, match='type: pip install'):
        require_base({'no-such-thing': '1.0'})


def test_versions_are_compared_as_numbers():
    require_base({'numpy': '1.9.0', 'scipy': '1.9'})  # 1.26 and 1.11 are newer


def test_every_command_begins_where_what_it_needs_is_looked_at():
    text = (ROOT / 'setup.py').read_text()
    for name in (*NODES, 'command_line'):
        assert callable(getattr(start, name))
    assert "f'{node} = {NAME}.start:{node}'" in text and 'start:command_line' in text


def test_documents_name_files_that_there_are():
    folders = ('continuum_loc', 'msg_tools', 'studies', 'bench', 'launch', 'config', 'test')
    kept = {str(path) for folder in folders for path in (ROOT / folder).rglob('*.py')}
    kept |= {'/setup.py', '/studies/NAME.py'}
    gone = {
        f'{page.name}: {name}'
        for page in [*(ROOT / 'docs').glob('*.md'), ROOT / 'README.md', ROOT / 'CONTRIBUTING.md']
        for name in re.findall(r'`([\w/]*\w+\.py)\b', page.read_text())
        if not any(path.endswith(f'/{name}') for path in kept)
    }
    assert not gone


def test_the_version_is_the_same_wherever_it_is_written():
    version = ElementTree.parse(ROOT / 'package.xml').getroot().findtext('version')
    assert re.search(rf'^version: {version}$', (ROOT / 'CITATION.cff').read_text(), re.MULTILINE)
    newest = re.search(
        r'^(\d+\.\d+\.\d+)\n-+$', (ROOT / 'CHANGELOG.rst').read_text(), re.MULTILINE
    )
    assert newest[1] == version
