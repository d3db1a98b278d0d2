"""Lines that microcontrollers write: each is a measurement, or is refused by name."""

import json
import os
import threading

from continuum_loc.errors import MessageError, RunFailure
from continuum_loc.intake import Intake
from continuum_loc.nodes.support.readings import lines, Readings
from continuum_loc.nodes.support.settings import DriverNodeSettings
from continuum_loc.robot import load_robot
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

ROBOT = load_robot('engine')
NOW = 1_700_000_000_000_000_000
TOF = {'sensor': 'ring1_tof1', 'distance_mm': [500] * 64, 'target_status': [5] * 64}
IMU = {'sensor': 'ring1_imu', 'gyro_raw': [0, 1000, 0], 'accel_raw': [0, 0, 8197]}
FIBRE = {'s': [0.1, 0.2], 'strains': [[35e-6, -17.5e-6, -17.5e-6]] * 2}


def read(line):
    """Return the sample of a line, as the driver takes it."""
    text = line if isinstance(line, bytes) else json.dumps(line).encode()
    sample = Readings(ROBOT, DriverNodeSettings(), lambda: NOW).sample(text)
    Intake(ROBOT).check('driver', sample)
    return sample


def but(reading, name, place, value):
    """Copy a reading with one value of one array replaced."""
    changed = list(reading[name])
    changed[place] = value
    return reading | {name: changed}


def test_the_stamp_is_the_readings_own_or_the_clock():
    assert read(IMU).stamp == NOW
    assert read(IMU | {'stamp': 12.5}).stamp == 12_500_000_000
    assert read(IMU | {'stamp': 12}).stamp == 12_000_000_000


REFUSED = [
    # A stamp of another unit, or none at all.
    (IMU | {'stamp': 1_700_000_000_123}, 'stamp', r'1700000000123 is no time .* \(milliseconds\?'),
    (IMU | {'stamp': 1_700_000_000_123_456}, 'stamp', r'\(microseconds\?\)'),
    (IMU | {'stamp': NOW}, 'stamp', r'\(nanoseconds\?\)'),
    (IMU | {'stamp': 2**31}, 'stamp', 'valid: 0 to 2147483647'),
    (IMU | {'stamp': 0}, 'stamp', 'no time in seconds'),
    (IMU | {'stamp': -1.0}, 'stamp', 'no time in seconds'),
    (IMU | {'stamp': True}, 'stamp', 'stamp True is not a number'),
    (IMU | {'stamp': '12.5'}, 'stamp', "stamp '12.5' is not a number"),
    (IMU | {'stamp': [12.5]}, 'stamp', 'is not a number'),
    (b'{"stamp": 1e400, "s": [0.1], "strains": [[0, 0, 0]]}', 'stamp', 'inf is no time'),
    # What the registers cannot hold: 8 bits of status, 16 bits of distance, rate and force.
    (but(TOF, 'target_status', 3, 261), 'value', 'target_status: 261; valid: .* 0 to 255'),
    (but(TOF, 'target_status', 3, -1), 'value', 'target_status: -1'),
    (but(TOF, 'target_status', 3, 5.5), 'value', 'target_status: 5.5; valid: whole numbers'),
    (but(TOF, 'distance_mm', 0, 32768), 'value', 'distance_mm: 32768 .is -32768 meant'),
    (but(TOF, 'distance_mm', 0, 1e9), 'value', 'distance_mm: 1000000000'),
    (TOF | {'range_sigma_mm': [65536] * 64}, 'value', 'range_sigma_mm: 65536; .* 0 to 65535'),
    (TOF | {'nb_target_detected': [256] * 64}, 'value', 'nb_target_detected: 256'),
    (but(IMU, 'gyro_raw', 0, 65530), 'value', 'gyro_raw: 65530 .is -6 meant, read without'),
    (but(IMU, 'accel_raw', 2, -32769), 'value', 'accel_raw: -32769; .* -32768 to 32767'),
    (but(IMU, 'gyro_raw', 0, 10**400), 'value', 'gyro_raw: holds a number beyond all limits'),
    (but(IMU, 'gyro_raw', 0, 10**30), 'value', 'gyro_raw: 1e.30'),
    (but(IMU, 'gyro_raw', 0, True), 'value', "gyro_raw: holds 'True', which is no number"),
    (but(IMU, 'gyro_raw', 0, '12'), 'value', "gyro_raw: holds '12', which is no number"),
    (but(IMU, 'gyro_raw', 0, None), 'value', "gyro_raw: holds 'None'"),
    (but(IMU, 'gyro_raw', 0, {}), 'value', "gyro_raw: holds '{}'"),
    (but(IMU, 'gyro_raw', 0, [1, 2]), 'value', 'gyro_raw: holds'),
    (but(FIBRE, 's', 0, float('nan')), 'value', 'NaN is no reading'),
    (IMU | {'gyro_raw': [float('-inf'), 0, 0]}, 'value', '-Infinity is no reading'),
    (FIBRE | {'strains': [[35, -17, -18]] * 2}, 'value', r'strain of 35.* \(microstrain\?\)'),
    (FIBRE | {'s': [0.1, 1.6]}, 'value', 'must rise within 0 to 1.5 m, got 0.1 to 1.6'),
    (FIBRE | {'s': [0.2, 0.1]}, 'value', 'must rise'),
    # Shapes.
    (TOF | {'distance_mm': [500] * 16}, 'size', 'distance_mm: 16 values; valid: 64'),
    (TOF | {'target_status': [5] * 65}, 'size', 'target_status: 65 values; valid: 64'),
    (IMU | {'gyro_raw': 7}, 'size', 'gyro_raw: 1 values; valid: 3'),
    (FIBRE | {'s': [0.1]}, 'size', r'strains of shape \(2, 3\) for 1 stations'),
    (FIBRE | {'s': [], 'strains': []}, 'size', 'for 0 stations'),
    (FIBRE | {'strains': [[0.0, 0.0], [0.0, 0.0]]}, 'size', 'at least 3 cores'),
    # Names and fields.
    (TOF | {'sensor': 'ring1_imu'}, 'unknown frame', "no such sensor 'ring1_imu'"),
    (TOF | {'sensor': 'x' * 5000}, 'unknown frame', 'x{80}'),
    (TOF | {'sensor': 7}, 'fields', "a sensor's name cannot be 7"),
    (TOF | {'sensor': ['ring1_tof1']}, 'fields', "a sensor's name cannot be"),
    ({'distance_mm': [500] * 64, 'target_status': [5] * 64}, 'fields', "argument: 'sensor'"),
    (IMU | {'model': 1}, 'fields', 'a reading with gyro_raw'),
    (IMU | {'gyro_mdps_per_lsb': 1}, 'fields', 'a reading with gyro_raw'),
    (TOF | IMU, 'fields', 'a reading with distance_mm'),
    ({'speed': 3}, 'fields', 'a reading of speed'),
    ({}, 'fields', 'a reading of nothing'),
    (b'{"s": [0.1], "s": [0.2], "strains": [[0, 0, 0]]}', 'fields', 'given twice: s'),
    # What is no reading at all.
    (b'[1, 2]', 'line', 'a list, not an object'),
    (b'"text"', 'line', 'a str, not an object'),
    (b'{"sensor": ', 'line', 'not JSON'),
    (b'\xff\xfe{}', 'line', 'not JSON'),
    (b'[' * 3000 + b']' * 3000, 'line', 'nested too deeply'),
    (b'[' * 30_000, 'line', 'nested too deeply'),
    (b'{"stamp": ' + b'9' * 5000 + b'}', 'line', 'not JSON'),
    (b'{"a": "' + b'x' * 70_000 + b'"}', 'line', 'a line of more than 65536 bytes'),
]


@pytest.mark.parametrize(
    ('line', 'kind', 'said'),
    REFUSED,
    ids=[f'{n}-{kind}' for n, (_, kind, _) in enumerate(REFUSED)],
)
def test_what_is_no_reading_is_refused_by_name_in_a_short_line(line, kind, said):
    with pytest.raises(MessageError, match=said) as refused:
        read(line)
    assert refused.value.kind == kind
    assert len(str(refused.value)) < 600


@given(line=st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_a_reading_or_refused(line):
    with pytest.raises(MessageError):
        read(line)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**30), 10**30)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(['ring1_tof1', 'ring1_imu']),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=12,
)
FIELDS = ('sensor', 'stamp', *TOF, *IMU, *FIBRE, 'range_sigma_mm', 'nb_target_detected')


@given(base=st.sampled_from([TOF, IMU, FIBRE]), name=st.sampled_from(FIELDS), value=JSON)
@settings(max_examples=300, deadline=None)
def test_any_value_in_any_field_gives_finite_numbers_or_is_refused(base, name, value):
    try:
        sample = read(base | {name: value})
    except MessageError:
        return
    assert 0 < sample.stamp < 2**31 * 10**9
    for field in ('angular_velocity', 'linear_acceleration', 's', 'theta', 'kappa'):
        assert np.isfinite(getattr(sample, field, 0.0)).all()


def lines_of(chunks, longest):
    """Write chunks into a pipe from another thread; the lines that come out."""
    reader, writer = os.pipe()

    def write():
        for chunk in chunks:
            os.write(writer, chunk)
        os.close(writer)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        return list(lines(reader, lambda: False, longest))
    finally:
        thread.join()
        os.close(reader)


def test_lines_come_whole_however_they_are_cut():
    assert lines_of([b'{"a"', b': 1}\n\n{"b": 2}\n{"c', b'": 3}'], 100) == [
        b'{"a": 1}',
        b'{"b": 2}',
        b'{"c": 3}',
    ]


def test_a_line_without_an_end_takes_no_memory_and_the_next_one_is_read():
    """A port that is read at a wrong speed writes anything but line ends."""
    found = lines_of([b'x' * 50_000] * 40 + [b'yz\n{"next": 1}\n'], 1000)
    assert len(found) == 2 and found[1] == b'{"next": 1}'
    assert found[0].startswith(b'xxx') and 1000 < len(found[0]) <= 66_536


def test_a_source_that_fails_is_named(monkeypatch):
    reader, writer = os.pipe()
    os.write(writer, b'x')

    def pulled_out(*_):
        raise OSError(5, 'Input/output error')

    monkeypatch.setattr(os, 'read', pulled_out)
    with pytest.raises(RunFailure, match='cannot be read any more .Input/output error.'):
        list(lines(reader, lambda: False, 1000))
    monkeypatch.undo()
    os.close(reader)
    os.close(writer)
