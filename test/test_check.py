"""What `continuum-loc check` finds: nothing in a good recording, and each fault by its name."""

from dataclasses import replace

from continuum_loc.estimator import settings_of
from continuum_loc.measurements import ImuSample, nanoseconds, TofFrame
from continuum_loc.offline.check import check_bag
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import simulate, Trial
from continuum_loc.robot import load_robot
from msg_tools.bag import BagWriter
from msg_tools.topics import topic_of
import pytest


@pytest.fixture(scope='module')
def recording():
    """Two seconds of the soft arm in its box, as described."""
    return list(simulate(Trial('soft_arm', 'R0', 'b1', seed=4, duration=2.0)))


@pytest.fixture
def checked(recording, tmp_path):
    """Check the recording, each sample as `change` makes it (None leaves it out)."""

    def check(change=lambda sample: sample, mapped=True, robot='soft_arm', late=lambda s: 0.01):
        with BagWriter(tmp_path / 'bag') as bag:
            for sample in recording:
                made = change(sample)
                if made is not None:
                    logged = made.stamp + nanoseconds(late(made))
                    bag.write(topic_of(made), made, logged)
        description = load_robot(robot)
        filter_ = make_filter(
            description, scene_map('R0') if mapped else None, settings_of(description.name, None)
        )
        return check_bag(tmp_path / 'bag', filter_)

    return check


def wrong(findings):
    return [(one.level, one.matter, one.text) for one in findings if one.level != 'ok']


def of(sample, kind):
    return isinstance(sample, kind)


def test_a_good_recording_has_nothing_to_find(checked):
    findings = checked()
    assert wrong(findings) == []
    assert {'topics', 'rates', 'clocks', 'estimate'} <= {one.matter for one in findings}


def test_a_sensor_that_is_silent_or_slow_is_named(checked):
    robot = load_robot('soft_arm')
    name, imu, rate = robot.tof[0].name, robot.imu[0].name, robot.imu_model.rate
    count = iter(range(10**6))

    def change(sample):
        if of(sample, TofFrame) and sample.sensor == name:
            return None
        if of(sample, ImuSample) and sample.sensor == imu:
            return sample if next(count) % 2 else None
        return sample

    found = wrong(checked(change))
    assert ('error', 'topics', f'nothing usable of {name}') in found
    assert ('warning', 'rates', f'{imu} comes at {rate / 2:g} Hz, described as {rate:g}') in found


def test_another_clock_is_told_from_a_slow_way(checked):
    imu = load_robot('soft_arm').imu[0].name
    ahead = wrong(checked(late=lambda s: -0.2 if of(s, ImuSample) and s.sensor == imu else 0.01))
    assert any(
        level == 'error' and f'stamps of {imu} are 0.200 s ahead' in t for level, _, t in ahead
    )


def test_frames_and_units_are_told_in_the_words_of_the_gate(checked):
    def change(sample):
        if of(sample, ImuSample):
            return replace(sample, sensor=f'left_{sample.sensor}')
        if of(sample, TofFrame):
            return replace(sample, points=1e3 * sample.points, ranges=1e3 * sample.ranges)
        return sample

    found = wrong(checked(change))
    assert any(m == 'frames' and "no such sensor 'left_" in t for _, m, t in found)
    assert any('millimetres' in t for _, _, t in found), found
    assert any(level == 'error' for level, _, _ in found)


def test_without_a_map_mounts_are_said_to_be_unchecked(checked):
    found = wrong(checked(mapped=False))
    assert ('warning', 'mounts', 'not checked against a map: none is given (--map)') in found
