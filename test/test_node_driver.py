"""Node `driver`: what microcontrollers write, line by line, comes as the contract's topics."""

import json
import os
import signal

from continuum_loc.robot import load_robot
from node_graph import Client, fresh_domain, Process, wait_until
import numpy as np
import pytest

pytestmark = pytest.mark.timeout(200)
TOPICS = ('tof/points', 'imu/data_raw', 'strain')
TOF = {'sensor': 'ring1_tof1', 'distance_mm': [400] * 64, 'target_status': [5] * 63 + [255]}
IMU = {'sensor': 'ring1_imu', 'gyro_raw': [0, 1000, 0], 'accel_raw': [0, 0, 8197]}
FIBRE = {'s': [0.1, 0.2], 'strains': [[35e-6, -17.5e-6, -17.5e-6]] * 2}
BAD = (  # a line, and what the log says of the first of its class
    ('{"sensor": ', 'not JSON'),
    ('[1, 2]', 'not JSON'),
    ('{"speed": 3}', 'a reading of speed; valid: sensor, distance_mm'),
    (json.dumps(IMU | {'temperature': 20}), 'a reading of speed'),
    (json.dumps(TOF | {'sensor': 'nobody'}), "no such sensor 'nobody'; valid: ring1_tof1"),
    (json.dumps(TOF | {'distance_mm': [1, 2]}), 'distance_mm: 2 values; valid: 64'),
    (json.dumps(IMU | {'stamp': 'noon'}), "stamp 'noon' is not a number of seconds"),
)
REFUSED = '"refused": {"line": 2, "fields": 2, "unknown frame": 1, "size": 1, "stamp": 1}'


def test_raw_readings_become_measurements_and_bad_lines_are_named(tmp_path):
    port, domain = tmp_path / 'port', fresh_domain()
    os.mkfifo(port)
    node = Process('driver', domain, tmp_path, source=port, delay=0.25)
    node.await_log('reading')
    with Client(domain) as client, port.open('w') as writer:
        tof, imu, strain = (client.hear(topic) for topic in TOPICS)
        client.await_speakers()
        before = client.now()
        for line in (*(line for line, _ in BAD), *map(json.dumps, (TOF, IMU, FIBRE))):
            writer.write(line + '\n')
        writer.write(json.dumps(IMU | {'stamp': 12.5})[:20])  # a port may pause within a line
        writer.flush()
        assert client.until(lambda: tof and imu and strain), node.log
        writer.write(json.dumps(IMU | {'stamp': 12.5})[20:] + '\n')
        writer.flush()
        assert client.until(lambda: len(imu) == 2), node.log
        now = client.now()
    for _, text in BAD:
        assert wait_until(lambda text=text: text in node.log), (text, node.log)
    model = load_robot('engine').tof_model
    assert np.isfinite(tof[0].ranges).sum() == 63
    along = model.directions[:63, 0] if model.convention == 'perpendicular' else 1.0
    np.testing.assert_allclose(tof[0].ranges[:63] * along, 0.4, rtol=1e-6)
    np.testing.assert_allclose(imu[0].angular_velocity, [0.0, np.radians(17.5), 0.0])
    np.testing.assert_allclose(imu[0].linear_acceleration, [0.0, 0.0, 9.80665], rtol=1e-3)
    np.testing.assert_allclose(strain[0].kappa, 1.0, rtol=1e-6)
    assert before - 0.3e9 < imu[0].stamp <= now - 0.25e9 and imu[1].stamp == 12_500_000_000
    assert node.stop(signal.SIGTERM) == 0 and 'Traceback' not in node.log, node.log
    assert '"published": {"tof/points": 1, "imu/data_raw": 2, "strain": 1}' in node.log
    assert REFUSED in node.log


def test_lines_that_would_end_a_reader_are_refused_and_the_node_goes_on(tmp_path):
    """Each of them ended the reader, or was published as something else, once."""
    numbers = {'sensor': 'ring1_tof3', 'distance_mm': [int('9' * 400)] * 64}
    lines = [
        json.dumps(IMU | {'stamp': 1_700_000_000_123}),
        json.dumps(TOF | {'target_status': [261] * 64}),
        json.dumps(IMU | {'gyro_raw': [65530, 0, 0]}),
        json.dumps(IMU | {'gyro_raw': [float('nan'), 0, 0]}),
        json.dumps(numbers | {'target_status': [5] * 64}),
        '[' * 3000 + ']' * 3000,
        'x' * 200_000,
        json.dumps(IMU),
    ]
    file = tmp_path / 'readings.jsonl'
    file.write_text('\n'.join(lines))
    node = Process('driver', fresh_domain(), tmp_path, source=file)
    assert node.wait() == 0 and 'Traceback' not in node.log, node.log
    assert '"published": {"imu/data_raw": 1}' in node.log
    assert '"refused": {"stamp": 1, "value": 4, "line": 2}' in node.log
    assert '(milliseconds?)' in node.log and 'nested too deeply' in node.log


def test_a_port_that_is_pulled_out_ends_the_node_with_an_error(tmp_path):
    """A node that lives on without its reader is deaf, and nobody knows."""
    ours, theirs = os.openpty()
    node = Process('driver', fresh_domain(), tmp_path, source=os.ttyname(theirs))
    node.await_log('reading')
    os.close(theirs)
    os.close(ours)
    assert wait_until(lambda: node.popen.poll() is not None), node.log
    assert node.popen.returncode == 2 and 'Traceback' not in node.log
    assert 'error: the source is a port that has gone' in node.log


def test_a_file_is_read_to_its_end_and_a_missing_port_is_one_clear_line(tmp_path):
    file = tmp_path / 'readings.jsonl'
    file.write_text('\n'.join(map(json.dumps, (TOF, IMU, FIBRE))))
    whole = Process('driver', fresh_domain(), tmp_path, source=file)
    missing = Process('driver', fresh_domain(), tmp_path, source=tmp_path / 'absent')
    assert whole.wait() == 0 and '"strain": 1' in whole.log, whole.log
    assert missing.wait() == 2 and 'No such file' in missing.log, missing.log
    assert 'Traceback' not in missing.log
