"""
Settings files: numbers and words mean what a person means by them, and names are only names.

YAML 1.1 reads 015 as 13, 12:30:00 as 45000, no as false, and of two equal keys the last.
"""

import math

from continuum_loc.errors import SettingsError
from continuum_loc.estimator.settings import load_estimator_settings
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.settings import dump_settings, load_settings, LONGEST_NAME, parse_settings
from continuum_loc.shape import load_shape_settings
from continuum_loc.simulator.plant import load_plant
from continuum_loc.simulator.trajectories import TrajectoryFile
from continuum_loc.yaml_files import check_parameter_file, DEEPEST, read_yaml, write_yaml
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest
import yaml

ROBOT = 'name: a\nlength: 0.5\nradius: 0.01\nrings: [{name: r1, s: 0.5}]\n'


@pytest.fixture
def written(tmp_path):
    def write(text, name='mine.yaml'):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def refused(load, path, said):
    with pytest.raises(SettingsError, match=said) as error:
        load(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert '\n' not in message and len(message) < 500


def test_leading_zeros_make_no_number_octal(written):
    robot = load_robot(
        written(ROBOT + 'base: {rpy_deg: [000, 045, 010]}\ntof_model: {rate: 015}\n')
    )
    assert robot.base.rpy_deg == (0.0, 45.0, 10.0)
    assert robot.tof_model.rate == 15.0


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('015', 15),
        ('-017', -17),
        ('08', 8),
        ('0x10', 16),
        ('0o10', 8),
        ('1e3', 1000.0),
        ('1e-3', 0.001),
        ('.5', 0.5),
        ('5.', 5.0),
        ('010.5', 10.5),
        ('-.inf', -math.inf),
        ('12:30:00', '12:30:00'),
        ('1:30', '1:30'),
        ('1_000', '1_000'),
        ('2024-01-01', '2024-01-01'),
        ('0b11', '0b11'),
        ('yes', 'yes'),
        ('No', 'No'),
        ('on', 'on'),
        ('OFF', 'OFF'),
        ('y', 'y'),
        ('true', True),
        ('FALSE', False),
        ('~', None),
        ('null', None),
        ('', None),
        ("'015'", '015'),
        ('nan', 'nan'),
        ('=', '='),
    ],
)
def test_plain_values_are_those_of_the_core_schema(written, text, value):
    """YAML 1.2.2, section 10.3.2."""
    read = read_yaml(written(f'a: {text}\n')).data['a']
    assert read == value and type(read) is type(value)


def test_words_are_words_where_a_text_is_asked_for_and_truth_where_truth_is(written):
    robot = load_robot(
        written(
            ROBOT.replace('name: a', 'name: no') + 'tof_model: {flip_rows: on, flip_columns: no}'
        )
    )
    assert (robot.name, robot.tof_model.flip_rows, robot.tof_model.flip_columns) == (
        'no',
        True,
        False,
    )


@pytest.mark.parametrize(
    ('line', 'said'),
    [
        ('tof_model: {rate: 12:30:00}', r"tof_model\.rate: .*'12:30:00'.*\[line 5\]"),
        ('tof_model: {rate: true}', r'tof_model\.rate: a number is needed.*\[line 5\]'),
        ('base: {xyz: [0, yes, 0]}', r'base\.xyz\.1: .*\[line 5\]'),
        ('base: {xyz: [0, false, 0]}', r'base\.xyz: a number is needed.*\[line 5\]'),
        ('base: {xyz: [0,5, 1,5, 2,0]}', r'base\.xyz: .*at most 3 items'),
        ('base: {xyz: [1e999, 0, 0]}', r'base\.xyz\.0: .*finite'),
        (f'base: {{xyz: [1{"0" * 400}, 0, 0]}}', 'line 5: .* is no whole number'),
        ('base: {xyz: [.nan, 0, 0]}', r'base\.xyz\.0: .*finite'),
        ('bas: {xyz: [0, 0, 0]}', r"unknown key 'bas'; did you mean 'base'\?.*\[line 5\]"),
    ],
)
def test_what_is_no_number_is_refused_with_its_line(written, line, said):
    refused(load_robot, written(ROBOT + line + '\n'), said)


def test_a_key_given_twice_is_refused_with_both_lines(written):
    text = ROBOT + 'base: {xyz: [1.0, 0.0, 0.0]}\nbase: {xyz: [0.0, 0.0, 0.0]}\n'
    refused(load_robot, written(text), "line 6: key 'base' is given twice, first in line 5")
    inner = ROBOT + 'base:\n  xyz: [1, 0, 0]\n  rpy_deg: [0, 0, 0]\n  xyz: [0, 0, 0]\n'
    refused(load_robot, written(inner), "line 8: key 'xyz' is given twice, first in line 6")
    quoted = ROBOT + '"name": b\n'
    refused(load_robot, written(quoted), "line 5: key 'name' is given twice, first in line 1")


LOADERS = {
    'robot': load_robot,
    'plant': load_plant,
    'preset': load_estimator_settings,
    'shape': load_shape_settings,
    'trajectory': lambda path: load_settings(TrajectoryFile, path),
}


@pytest.mark.parametrize('kind', LOADERS)
def test_every_kind_of_settings_file_is_read_by_the_same_rules(written, kind):
    load = LOADERS[kind]
    refused(load, written('a: 1\na: 2\n'), "line 2: key 'a' is given twice, first in line 1")
    refused(load, written('[' * 5000), 'line 1: nested deeper than 50 levels')
    refused(load, written('a: !!python/name:os.system\n'), 'line 1: tag .* is not allowed')
    refused(load, written(b'\xff\xfe\x00'), 'not a text file')
    refused(load, written('- 1\n'), 'expected a mapping of keys, got list')
    refused(load, written('a: [1\n'), 'not valid YAML')
    refused(load, written('a: 1\n---\na: 2\n'), 'not valid YAML')


@pytest.mark.parametrize('opening', ['[', '{a: ', '- ', '? '])
def test_depth_is_limited(written, opening):
    refused(load_robot, written(ROBOT + 'x:\n ' + opening * 5000), 'nested deeper|not valid YAML')
    allowed = f'a: {"[" * (DEEPEST - 1)}{"]" * (DEEPEST - 1)}\n'
    assert read_yaml(written(allowed)).data['a'] is not None


def test_anchors_are_kept_and_those_that_unfold_without_end_are_refused(written):
    """Nine lists of nine of the one before: 9^9 values of a file of 500 bytes."""
    shared = ROBOT + 'base: &b {xyz: [1, 2, 3], rpy_deg: &r [0, 0, 0]}\n'
    assert load_robot(written(shared)).base.xyz == (1.0, 2.0, 3.0)
    merged = 'a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}\n'
    assert read_yaml(written(merged)).data['b'] == {'x': 1, 'y': 3}
    names = 'abcdefghi'
    lines = ['a: &a [lol, lol, lol, lol, lol, lol, lol, lol, lol]']
    lines += [
        f'{n}: &{n} [{", ".join([f"*{p}"] * 9)}]' for p, n in zip(names, names[1:], strict=False)
    ]
    refused(load_robot, written('\n'.join(lines)), 'more than 100000 values')
    refused(load_robot, written('a: &a [*a]\n'), 'line 1: an anchor that holds itself')


def test_size_is_limited_before_the_file_is_read(written):
    path = written(ROBOT)
    with path.open('r+b') as stream:
        stream.truncate(10**12)  # a sparse file: no such space is taken
    refused(load_robot, path, 'larger than 4 MB')


def test_what_is_no_file_is_told(tmp_path):
    (tmp_path / 'folder.yaml').mkdir()
    refused(load_robot, tmp_path / 'folder.yaml', 'a folder, not a file')
    refused(load_robot, tmp_path / 'absent.yaml', 'cannot be read')


@pytest.mark.parametrize(
    'encoded',
    [
        b'\xef\xbb\xbf' + ROBOT.encode(),
        ROBOT.encode('utf-16'),
        ROBOT.replace('\n', '\r\n').encode(),
    ],
    ids=['UTF-8 with a mark', 'UTF-16', 'CRLF'],
)
def test_marks_and_line_ends_of_other_systems_are_read(written, encoded):
    assert load_robot(written(encoded, 'MINE.YAML')).length == 0.5


# Names


BAD_NAMES = (
    'r/1',
    '../r1',
    '.',
    '..',
    '.r1',
    'r 1',
    'r<b>1',
    '[red]r',
    'r\n',
    '',
    'r1\x00',
    'ß',
    'a' * 101,
)


@pytest.mark.parametrize('name', BAD_NAMES)
@pytest.mark.parametrize('place', ['robot', 'ring', 'sensor'])
def test_a_name_in_which_a_path_or_markup_hides_is_refused(place, name):
    data = yaml.safe_load(ROBOT)
    if place == 'robot':
        data['name'] = name
    elif place == 'ring':
        data['rings'][0]['name'] = name
    else:
        data['imu'] = [{'name': name, 'ring': 'r1'}]
    with pytest.raises(SettingsError, match='letters, digits, `_`, `-` and `.`|at most 100'):
        parse_settings(RobotDescription, data)


def test_a_ring_called_like_a_path_is_refused_with_its_line(written):
    path = written(ROBOT.replace('name: r1', 'name: "r/1"'))
    refused(load_robot, path, r"rings\.0\.name: 'r/1' is no name: use letters, digits.*\[line 4\]")


@pytest.mark.parametrize('name', ['r1', 'Ring_1', '1', 'ring-1.a', '_', 'a' * LONGEST_NAME])
def test_plain_names_are_taken(name):
    data = yaml.safe_load(ROBOT)
    data['rings'][0]['name'] = name
    assert parse_settings(RobotDescription, data).ring_names == (name,)


# Units


@pytest.mark.parametrize(
    ('line', 'said'),
    [
        ('length: 500', r'length of 500 m .* millimetres: write metres \(0.5\)'),
        ('radius: 10', r'radius of 10 m .* millimetres: write metres \(0.01\)'),
        (
            'imu: [{name: i, ring: r1, mount: {azimuth_deg: 0, radius: 10}}]',
            "mount of 'i' of 10 m",
        ),
        (
            'imu: [{name: i, ring: r1, mount: {xyz: [0, 3, 4], rpy_deg: [0, 0, 0]}}]',
            "mount of 'i' of 5 m",
        ),
        ('tof_model: {max_range: 4000}', 'max_range of 4000 m .* looks like millimetres'),
        ('rings: [{name: r1, s: 500}]', "'s' of ring 'r1' of 500 m .* looks like millimetres"),
        ('strain: {spacing: 30}', 'strain.spacing of 30 m .* looks like millimetres'),
    ],
)
def test_a_robot_in_millimetres_is_refused(written, line, said):
    key = line.split(':')[0]
    kept = [row for row in ROBOT.splitlines() if not row.startswith(f'{key}:')]
    refused(load_robot, written('\n'.join([*kept, line, ''])), said)


@pytest.mark.parametrize('name', ['engine', 'soft_arm', 'hall_arm', 'tendon_robot'])
def test_the_bundled_robots_are_in_metres_and_named_well(name):
    assert load_robot(name).name == name


# Writing


words = st.text(st.characters(codec='utf-8', exclude_categories=['Cs']), max_size=12)
ambiguous = st.sampled_from(
    ['015', '0o17', '1e5', 'no', 'on', '12:30:00', '1_000', '~', 'null', 'true', '.inf', '<<', '=']
)
values = st.recursive(
    words | ambiguous | st.integers(-(10**9), 10**9) | st.floats() | st.booleans() | st.none(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(words | ambiguous, inner, max_size=3)
    ),
    max_leaves=10,
)


def same(a, b):
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return a == b and type(a) is type(b)


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(words | ambiguous, values, max_size=4))
def test_what_is_written_is_read_back_as_it_was(tmp_path_factory, data):
    """By us, and by a reader of YAML 1.1."""
    path = tmp_path_factory.mktemp('yaml') / 'a.yaml'
    write_yaml(data, path)
    assert same(data, read_yaml(path).data)
    assert same(data, yaml.safe_load(path.read_text(encoding='utf-8')))


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_bytes_are_settings_or_an_error_in_one_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp('yaml') / 'a.yaml'
    path.write_bytes(data)
    try:
        read_yaml(path)
    except SettingsError as error:
        assert str(error).startswith(str(path)) and '\n' not in str(error)


def test_settings_that_are_dumped_load_as_equal(tmp_path):
    preset = load_estimator_settings('engine')
    dump_settings(preset, tmp_path / 'preset.yaml')
    assert load_estimator_settings(tmp_path / 'preset.yaml') == preset


# Files of ROS parameters, which ROS itself reads


PARAMETERS = '/**:\n  ros__parameters:\n    robot: engine\n'


@pytest.mark.parametrize(
    ('lines', 'said'),
    [
        ('    delay: 015\n', 'line 4: 015: ROS reads a number that begins with 0 as octal'),
        ('    rates: [1, 010]\n', 'line 4: 010: ROS reads'),
        (
            '    delay: 1.0\n    delay: 2.0\n',
            "line 5: key 'delay' is given twice, first in line 4",
        ),
        ('    robot: soft_arm\n', "line 4: key 'robot' is given twice, first in line 3"),
    ],
)
def test_parameters_that_ros_reads_otherwise_than_meant_are_refused(written, lines, said):
    refused(check_parameter_file, written(PARAMETERS + lines), said)


def test_parameters_that_are_plain_are_left_to_ros(written):
    text = (
        PARAMETERS + '    delay: 0.5\n    rate: 10\n    word: "015"\n    zero: 0\n    use: yes\n'
    )
    assert check_parameter_file(written(text)) is None
