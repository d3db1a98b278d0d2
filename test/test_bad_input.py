"""
What a simulation refuses, and how it says so.

An error comes before the first step or at the one that diverged, names what was wrong, and leaves
no bag behind.
"""

from functools import cache
import logging

from continuum_loc.errors import SceneError, SettingsError, SimulationDiverged
from continuum_loc.offline.trials import Trial, world, write_bag
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.settings import load_settings, parse_settings
from continuum_loc.simulator.plant import load_plant, PlantSettings
from continuum_loc.simulator.scenes import load_scene
from continuum_loc.simulator.world import World
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import trimesh
import yaml

NOT_FINITE = (float('nan'), float('inf'), -float('inf'))


def changed(data, place, value):
    """Copy nested mappings and lists with the value at `place` replaced."""
    if not place:
        return value
    copy = dict(data) if isinstance(data, dict) else list(data)
    copy[place[0]] = changed(data[place[0]], place[1:], value)
    return copy


def numbers(data, place=()):
    """Places of all numbers in nested mappings and lists."""
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from numbers(value, (*place, key))
    elif isinstance(data, float):
        yield place


@cache
def plain(kind, name):
    load = load_robot if kind is RobotDescription else load_plant
    return load(name).model_dump(mode='json', exclude_none=True)


FILES = [
    *((RobotDescription, name) for name in ('engine', 'soft_arm', 'hall_arm', 'tendon_robot')),
    *((PlantSettings, name) for name in ('engine', 'soft_arm', 'hall_arm')),
]


@given(st.data())
@settings(max_examples=300, deadline=None)
def test_any_number_that_is_not_finite_is_refused_with_its_place(data):
    kind, name = data.draw(st.sampled_from(FILES))
    place = data.draw(st.sampled_from(sorted(numbers(plain(kind, name)), key=str)))
    value = data.draw(st.sampled_from(NOT_FINITE))
    with pytest.raises(SettingsError) as refused:
        parse_settings(kind, changed(plain(kind, name), place, value), where='mine.yaml')
    message = str(refused.value)
    assert message.startswith(f'mine.yaml: {".".join(map(str, place))}: ')
    assert 'finite number' in message


@pytest.mark.parametrize('key', ['EI', 'GJ', 'EA', 'mass_per_metre', 'carriage_mass'])
@pytest.mark.parametrize('value', [0.0, -1.0])
def test_what_has_to_be_positive_is(key, value):
    with pytest.raises(SettingsError, match=rf'plant: {key}: .*greater than 0 \(got'):
        parse_settings(PlantSettings, {**plain(PlantSettings, 'engine'), key: value}, 'plant')


@pytest.mark.parametrize('key', ['relaxation', 'contact_friction'])
def test_what_must_not_be_negative_is_not(key):
    with pytest.raises(SettingsError, match=rf'plant: {key}: .*greater than or equal to 0 \(got'):
        parse_settings(PlantSettings, {**plain(PlantSettings, 'engine'), key: -0.1}, 'plant')


@pytest.mark.parametrize(
    ('place', 'value', 'message'),
    [
        (('rings', 1, 's'), 0.3, r'from base to tip without overlap, got s = \[0.3, 0.3'),
        (('rings', 4, 's'), 1.6, "ring 'ring5' at s = 1.6 lies beyond the length 1.5"),
        (('tof', 0, 'mount', 'radius'), 0.01, "'ring1_tof1' sits inside the body"),
        (
            ('tof', 0, 'mount'),
            {'xyz': [0.0, 0.0, 0.0], 'rpy_deg': [0.0, 0.0, 0.0]},
            "'ring1_tof1' sits inside the body .* at s = 0.3 m",
        ),
        (('base', 'insertion', 'range'), [0.6, 0.0], r'the least travel comes first'),
        (('base', 'insertion', 'mode'), 'fixed', r'range \[0.0, 0.6\] with mode fixed'),
        (('tof_model', 'min_range'), 5.0, 'min_range 5.0 m must be below max_range 4.0 m'),
        (('tof_model', 'noise_distance'), [0.1, 0.2], 'one value each .* got 2 and 3'),
        (('tof_model', 'noise_distance'), [1.2, 0.6, 0.1], 'noise_distance must increase'),
        (('tof_model', 'noise_coefficient'), [-0.1, 0.1, 0.1], 'must be greater than 0'),
    ],
)
def test_descriptions_of_impossible_robots_are_refused_in_a_line(place, value, message):
    data = changed(plain(RobotDescription, 'engine'), place, value)
    with pytest.raises(SettingsError, match=message) as refused:
        parse_settings(RobotDescription, data, where='mine.yaml')
    assert len(str(refused.value)) < 250  # the place and the reason, not the whole file


def test_a_file_that_is_no_text_is_refused_by_name(tmp_path):
    (tmp_path / 'robot.yaml').write_bytes(bytes(range(256)))
    with pytest.raises(SettingsError, match=r'robot\.yaml: not a text file'):
        load_settings(RobotDescription, tmp_path / 'robot.yaml')


# A plant that does not go with its robot.


@pytest.mark.parametrize(
    ('place', 'value', 'message'),
    [
        (('tendons', 2, 'end'), 1.7, r'tendons\.2\.end = 1.7 m lies beyond the length 1.5 m'),
        (('tendons', 0, 'radius'), 0.5, r'tendons\.0\.radius = 0.5 m lies outside the body'),
        (('tendons', 0, 'max_force'), 5.0, 'tendon1_1 would have to pull .* its limit is 5 N'),
        (('tendons',), plain(PlantSettings, 'engine')['tendons'][:2], 'plant has 2 sets'),
        (('tendons',), [], 'the plant has 0 sets of tendons'),
        (('mass_per_metre',), 1e-12, 'mass_per_metre = 1e-12 kg/m makes links of'),
        (('profiles', 'live', 'link_length'), 1e-6, 'into 1500000 links; at most 1000'),
        (('profiles', 'live', 'time_step'), 0.02, 'too long for the insertion drive'),
    ],
)
def test_a_plant_that_cannot_be_this_robots_is_refused_before_the_start(place, value, message):
    data = changed(plain(PlantSettings, 'engine'), place, value)
    with pytest.raises(SettingsError, match=message):
        World(load_robot('engine'), None, 't1', plant=parse_settings(PlantSettings, data))


def test_the_step_of_a_base_that_does_not_travel_is_not_held_to_an_insertion_drive():
    data = changed(plain(PlantSettings, 'hall_arm'), ('profiles', 'live', 'time_step'), 0.02)
    made = World(load_robot('hall_arm'), None, 'free1', plant=parse_settings(PlantSettings, data))
    assert made.body.model.opt.timestep == 0.02


def test_a_robot_without_a_plant_is_told_how_to_give_one():
    mine = load_robot('engine').model_copy(update={'name': 'mine'})
    with pytest.raises(SettingsError, match="'mine' has no plant .*--plant my_plant.yaml"):
        World(mine, None, 't1')


def test_a_travel_farther_than_the_robot_is_long_is_said(caplog):
    data = changed(plain(RobotDescription, 'engine'), ('base', 'insertion', 'range'), [0.0, 5.0])
    with caplog.at_level(logging.WARNING):
        World(parse_settings(RobotDescription, data), None, 't1')
    assert 'travels 5 m, farther than its length of 1.5 m' in caplog.text


@pytest.mark.parametrize('duration', [0.0, -1.0, float('nan'), float('inf')])
def test_a_duration_that_is_none_is_refused(duration):
    with pytest.raises(SettingsError, match=f'duration {duration} s: must be finite'):
        World(load_robot('hall_arm'), None, 'free1').run(duration)


def test_an_unknown_fidelity_names_the_valid_ones():
    with pytest.raises(SettingsError, match="'best': give paper or vl53l5cx"):
        World(load_robot('hall_arm'), None, 'free1', tof_fidelity='best')


def test_a_tension_that_the_drive_cannot_give_is_refused(tmp_path):
    frames = [
        {'time': time, 'tensions': [5.0, 5.0, 5.0, force]} for time, force in ((1, 5), (2, 41))
    ]
    path = tmp_path / 'path.yaml'
    path.write_text(yaml.safe_dump({'keyframes': frames}))
    with pytest.raises(
        SettingsError, match=r'keyframes\.1\.tensions: tendon1_4 pulls 41 N, .* max_force is 40 N'
    ):
        World(load_robot('hall_arm'), None, str(path))


# A robot that does not go with its scene.


def placed(name, xyz):
    robot = load_robot(name)
    base = robot.base.model_copy(update={'xyz': xyz})
    base.__dict__.pop('T_map_base', None)  # computed from xyz, once
    return robot.model_copy(update={'base': base})


@pytest.mark.parametrize(
    'xyz', [(0.5, 0.0, 0.0), (0.2, 0.0, 1.5)], ids=['in the hub', 'in the casing']
)
def test_a_robot_that_starts_in_matter_is_refused_with_the_place(xyz):
    with pytest.raises(SceneError, match=r"'S0': the straight robot 'engine'.* at s = 0\.\d+ m"):
        World(placed('engine', xyz), load_scene('S0'), 't1')


def test_a_robot_out_of_sight_of_the_scene_is_refused_with_the_distance():
    with pytest.raises(SceneError, match=r"'S0' lies 98\.\d m away from robot 'engine'"):
        World(placed('engine', (-100.0, 0.0, 1.0)), load_scene('S0'), 't1')


def mesh_scene(tmp_path, monkeypatch, extents, centre, inward):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    box = trimesh.creation.box(extents)
    box.apply_translation(centre)
    if inward:
        box.invert()
    box.export(tmp_path / 'mine.stl')
    return load_scene(tmp_path / 'mine.stl')


@pytest.mark.parametrize(
    ('extents', 'centre', 'inward'),
    [
        ((0.3, 0.3, 0.3), (0.5, 0.0, 1.0), False),
        ((0.3, 0.3, 0.3), (0.5, 0.4, 1.0), True),
        ((4.0, 3.0, 3.0), (1.0, 0.0, 1.0), False),
        ((4.0, 3.0, 3.0), (30.0, 0.0, 1.0), True),
    ],
    ids=['block on the robot', 'block inside out', 'room inside out', 'outside of the room'],
)
def test_a_mesh_with_the_robot_in_its_matter_is_refused(
    tmp_path, monkeypatch, extents, centre, inward
):
    scene = mesh_scene(tmp_path, monkeypatch, extents, centre, inward)
    with pytest.raises(SceneError, match='inside of matter .* outward on a solid, inward on'):
        World(load_robot('engine'), scene, 't1')


def test_a_thin_wall_across_the_robot_is_refused(tmp_path, monkeypatch):
    """No node lies in a plate of 4 mm, but the links do."""
    scene = mesh_scene(tmp_path, monkeypatch, (0.004, 0.5, 0.5), (0.515, 0.0, 1.0), False)
    with pytest.raises(SceneError, match=r'inside of matter at s = 0\.69 m'):
        World(load_robot('engine'), scene, 't1')


@pytest.mark.parametrize(
    ('extents', 'centre', 'inward'),
    [((4.0, 3.0, 3.0), (1.0, 0.0, 1.0), True), ((0.3, 0.3, 0.3), (0.5, 0.4, 1.0), False)],
    ids=['in a room', 'beside a block'],
)
def test_a_robot_with_free_way_is_taken(tmp_path, monkeypatch, extents, centre, inward):
    scene = mesh_scene(tmp_path, monkeypatch, extents, centre, inward)
    places, depth = World(load_robot('engine'), scene, 't1').body.straight()
    np.testing.assert_allclose(places[0], [-0.2, 0.0, 1.0])
    assert depth.max() == 0.0


def test_an_empty_mesh_file_and_a_folder_are_told_apart(tmp_path):
    (tmp_path / 'empty.stl').touch()
    (tmp_path / 'folder.stl').mkdir()
    with pytest.raises(SceneError, match=r'empty\.stl: the file is empty'):
        load_scene(tmp_path / 'empty.stl')
    with pytest.raises(SceneError, match=r'folder\.stl: a folder, not a mesh file'):
        load_scene(tmp_path / 'folder.stl')


# No half of a bag.


def test_a_simulation_that_diverges_leaves_no_bag(tmp_path):
    soft = {**plain(PlantSettings, 'engine'), 'EI': 1e-6, 'GJ': 1e-6}
    (tmp_path / 'thread.yaml').write_text(yaml.safe_dump(soft))
    trial = Trial('engine', trajectory='t1', plant=str(tmp_path / 'thread.yaml'))
    with pytest.raises(SimulationDiverged, match=r"diverged at .* in joint 'bend\d+'.*time_step"):
        write_bag(tmp_path / 'bag', world(trial).run(1.0))
    assert not (tmp_path / 'bag').exists()


def test_an_interrupted_recording_leaves_no_bag_and_one_in_the_way_stays(tmp_path):
    def interrupted():
        yield from list(World(load_robot('hall_arm'), None, 'free1').run(0.1))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_bag(tmp_path / 'bag', interrupted())
    assert not (tmp_path / 'bag').exists()
    (tmp_path / 'older').mkdir()
    with pytest.raises(ValueError, match='exists already'):
        write_bag(tmp_path / 'older', interrupted())
    assert (tmp_path / 'older').is_dir()
