"""Settings files of every kind, and files of ROS parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.mapping.scale import map_for
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.settings import load_settings
from continuum_loc.shape import load_shape_settings
from continuum_loc.simulator.plant import load_plant
from continuum_loc.simulator.trajectories import TrajectoryFile
from continuum_loc.yaml_files import check_parameter_file
import numpy as np
from studies._input_case import Case, EITHER, READ, REFUSED

ROBOT = 'name: a\nlength: 0.5\nradius: 0.01\nrings: [{name: r1, s: 0.5}]\n'
EYE = 'tof: [{name: eye, ring: r1, mount: {azimuth_deg: 0, radius: 0.01}}]\n'
LOADERS: dict[str, Callable[[Path], Any]] = {
    'robot': load_robot,
    'plant': load_plant,
    'preset': load_estimator_settings,
    'shape': load_shape_settings,
    'trajectory': partial(load_settings, TrajectoryFile),
}


def settings_cases(seed: int) -> Iterator[Case]:
    """All settings files."""
    yield from _numbers()
    yield from _limits()
    yield from _names()
    yield from _units()
    yield from _parameters()
    yield from _cut(np.random.default_rng(seed))


def _case(
    name: str,
    text: str | bytes,
    right: str,
    judge: Callable[[Any], str] = lambda value: '',
    load: Callable[[Path], Any] = load_robot,
) -> Case:
    def write(folder: Path) -> Path:
        path = folder / 'mine.yaml'
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return Case('settings', name, write, load, right, judge)


def _equals(place: str, expected: Any) -> Callable[[RobotDescription], str]:
    """Judge a robot by one value of it."""

    def judge(robot: RobotDescription) -> str:
        value = robot
        for name in place.split('.'):
            value = getattr(value, name)
        return '' if value == expected else f'{place} is {value} in place of {expected}'

    return judge


def _numbers() -> Iterator[Case]:
    rate = 'tof_model.rate'
    for text, value in (
        ('015', 15.0),
        ('08', 8.0),
        ('010.5', 10.5),
        ('0x10', 16.0),
        ('0o10', 8.0),
        ('1e1', 10.0),
        ('1e+1', 10.0),
        ('"015"', 15.0),
        ('.5', 0.5),
        ('5.', 5.0),
        ('+7', 7.0),
    ):
        line = f'tof_model: {{rate: {text}}}\n'
        yield _case(f'a rate of {text}', ROBOT + line, READ, _equals(rate, value))
    for text in (
        *(
            '12:30:00',
            '1:30',
            'yes',
            'true',
            'off',
            '~',
            '2024-01-01',
            '1,5',
            'nan',
            '.nan',
            '.inf',
        ),
        *('-15', '0', '1e999', '9' * 400, '[1]', '{a: 1}', 'fast', '!!python/name:len'),
    ):
        yield _case(f'a rate of {text[:20]}', f'{ROBOT}tof_model: {{rate: {text}}}\n', REFUSED)
    turned = 'base: {rpy_deg: [000, 045, 010]}\n'
    yield _case(
        'angles 000, 045, 010', ROBOT + turned, READ, _equals('base.rpy_deg', (0.0, 45.0, 10.0))
    )
    for word, truth in (('yes', True), ('off', False), ('On', True), ('true', True), ('n', False)):
        line = f'tof_model: {{flip_rows: {word}}}\n'
        yield _case(f'flip_rows {word}', ROBOT + line, READ, _equals('tof_model.flip_rows', truth))
    for word in ('no', 'on', 'y', 'null_1', '12:30'):
        right = REFUSED if ':' in word else READ
        text = ROBOT.replace('name: a', f'name: {word}')
        yield _case(f'a robot called {word}', text, right, _equals('name', word))
    for code in ('utf-8-sig', 'utf-16', 'utf-16-le', 'latin-1'):
        right = REFUSED if code == 'utf-16-le' else READ  # without its mark
        yield _case(f'in {code}', ROBOT.encode(code), right, _equals('length', 0.5))
    yield _case('lines end with CRLF', ROBOT.replace('\n', '\r\n'), READ, _equals('length', 0.5))


def _limits() -> Iterator[Case]:
    """Keys twice, depth, anchors, size: for every kind of file."""
    bomb = ['a: &a [lol, lol, lol, lol, lol, lol, lol, lol, lol]']
    for before, name in zip('abcdefgh', 'bcdefghi', strict=True):
        bomb.append(f'{name}: &{name} [{", ".join([f"*{before}"] * 9)}]')
    for kind, load in LOADERS.items():
        for name, text in {
            'a key twice': 'a: 1\na: 2\n',
            'a key twice, once in quotes': 'a: 1\n"a": 2\n',
            'brackets 5,000 deep': '[' * 5000 + ']' * 5000,
            'braces 100,000 deep': '{a: ' * 100_000,
            'anchors that unfold': '\n'.join(bomb),
            'an anchor in itself': 'a: &a [*a]\n',
            'a command': 'a: !!python/object/apply:os.system [true]\n',
            'two documents': 'a: 1\n---\nb: 1\n',
            'a list': '- 1\n- 2\n',
            'binary': bytes(range(256)),
            'no end of a bracket': 'a: [1, 2\n',
            'an unknown key': 'nonsense: 1\n',
        }.items():
            yield _case(f'{kind}: {name}', text, REFUSED, load=load)
    twice = ROBOT + 'base: {xyz: [1.0, 0.0, 0.0]}\nbase: {xyz: [0.0, 0.0, 0.0]}\n'
    yield _case('base twice', twice, REFUSED)
    yield _case('5 MB', ROBOT + '#' * 5_000_000, REFUSED)
    shared = ROBOT + 'base: &b {xyz: [1, 2, 3]}\n'
    yield _case('an anchor', shared, READ, _equals('base.xyz', (1.0, 2.0, 3.0)))


def _names() -> Iterator[Case]:
    for name in (
        'r/1',
        '../r',
        '.r',
        '.',
        'r 1',
        '<b>',
        '[red]',
        'r\\n',
        '',
        'é',
        'a' * 101,
        '$(r)',
        'a;b',
    ):
        text = ROBOT.replace('name: r1', f'name: "{name}"')
        yield _case(f'a ring called {name[:20]!r}', text, REFUSED)
        text = f'{ROBOT}imu: [{{name: "{name}", ring: r1}}]\n'
        yield _case(f'a sensor called {name[:20]!r}', text, REFUSED)
        text = ROBOT.replace('name: a', f'name: "{name}"')
        yield _case(f'a robot called {name[:20]!r}', text, REFUSED)
    for name in ('r-1', 'r.1', 'R_1', '1', 'a' * 100):
        text = ROBOT.replace('name: r1', f'name: "{name}"')
        yield _case(f'a ring called {name[:20]!r}', text, READ, _equals('ring_names', (name,)))


def _units() -> Iterator[Case]:
    millimetres = 'name: a\nlength: 500\nradius: 10\nrings: [{name: r1, s: 500}]\n'
    yield _case('a robot in millimetres', millimetres, REFUSED)
    for line in ('radius: 10', 'tof_model: {max_range: 4000}', 'strain: {spacing: 30}'):
        key = line.split(':')[0]
        kept = [row for row in ROBOT.splitlines() if not row.startswith(f'{key}:')]
        yield _case(f'{line}, in millimetres', '\n'.join([*kept, line, '']), REFUSED)
    for edge, right in (
        (2.0, READ),
        (0.3, READ),
        (2000.0, REFUSED),
        (0.002, REFUSED),
        (1e6, REFUSED),
    ):
        yield Case(
            'settings',
            f'a map {edge:g} m wide for a robot of 0.5 m',
            partial(_with_map, edge),
            _together,
            right,
        )


def _with_map(edge: float, folder: Path) -> Path:
    """Write a robot of 0.5 m and a wall of that edge."""
    (folder / 'mine.yaml').write_text(ROBOT + EYE)
    rows, columns = np.meshgrid(np.linspace(0.0, edge, 20), np.linspace(0.0, edge, 20))
    points = np.column_stack([rows.ravel(), columns.ravel(), np.zeros(400)])
    path = folder / 'map.npz'
    PriorMap(points, np.tile([0, 0, 1.0], (400, 1)), np.ones(400), spacing=edge / 19).save(path)
    return path


def _together(path: Path) -> PriorMap:
    return map_for(load_robot(path.parent / 'mine.yaml'), path)


def _parameters() -> Iterator[Case]:
    head = '/**:\n  ros__parameters:\n    robot: engine\n'
    for name, lines, right in (
        ('plain', '    delay: 0.5\n    rate: 10\n', READ),
        ('a quoted number', '    word: "015"\n', READ),
        ('an octal', '    delay: 015\n', REFUSED),
        ('an octal in a list', '    delays: [1, 010]\n', REFUSED),
        ('a key twice', '    robot: soft_arm\n', REFUSED),
        ('brackets 5,000 deep', f'    a: {"[" * 5000}\n', REFUSED),
    ):
        yield _case(f'parameters: {name}', head + lines, right, load=check_parameter_file)


def _cut(rng: np.random.Generator) -> Iterator[Case]:
    """Cut a robot anywhere: what is left may be a robot, with the numbers that it had."""
    whole = ROBOT + 'base: {xyz: [1.25, 2.5, 3.75], rpy_deg: [10, 20, 30]}\n'
    for cut in rng.integers(0, len(whole), 12):

        def judge(robot: RobotDescription) -> str:
            same = robot.length == 0.5 and robot.base.xyz in ((1.25, 2.5, 3.75), (0.0, 0.0, 0.0))
            return '' if same else f'{robot.length}, {robot.base.xyz}'

        yield _case(f'a robot cut at byte {cut}', whole[:cut], EITHER, judge)
