"""
Recorders that are killed, and disks that are full: what was written before can be read.

How many messages have to be there follows from what was written and flushed.
"""

import os
import shutil
import signal
import subprocess
import sys

from continuum_loc.errors import BagError
from continuum_loc.measurements import ImuSample
from continuum_loc.offline.mcap_survivors import Survivors
from continuum_loc.offline.repair import repair
from msg_tools.bag import BagWriter, open_bag, read_bag
from msg_tools.mcap import MAGIC, records
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

TICK = 10_000_000  # ns
WRITE = """
import os, resource, signal, sys
from continuum_loc.measurements import ImuSample
from msg_tools.bag import BagWriter
import numpy as np
path, flushed, limit = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
with BagWriter(path) as bag:
    try:
        for k in range(1, 1_000_000):
            force = np.array([0.0, 0.0, 9.81])
            bag.write('imu/data_raw', ImuSample(k * 10_000_000, 'a', np.full(3, float(k)), force))
            if k == flushed:
                bag.flush()
            if not limit and k == 20_000:
                os.kill(os.getpid(), signal.SIGKILL)
    except ValueError as error:
        print(error)
    bag.close()
    print(sum(bag.counts.values()))
"""


def write(path, flushed=0, limit=0):
    """Write up to 20,000 samples in a process that is killed, or meets a full disk."""
    return subprocess.run(
        [sys.executable, '-c', WRITE, str(path), str(flushed), str(limit)],
        capture_output=True,
        text=True,
        timeout=100,
    )


def samples(path):
    """Count the samples of a bag, which are the first of those written, in their order."""
    found = [item for _, item in read_bag(path)]
    assert [item.stamp for item in found] == [TICK * (k + 1) for k in range(len(found))]
    assert all(item.angular_velocity[0] == item.stamp / TICK for item in found)
    return len(found)


def test_a_recorder_that_is_killed_leaves_all_that_it_flushed(tmp_path):
    done = write(tmp_path / 'bag', flushed=12_345)
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / 'bag' / 'metadata.yaml').exists()
    with pytest.raises(BagError, match='continuum-loc repair'):
        list(read_bag(tmp_path / 'bag'))
    before = {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()}
    saved = repair(tmp_path / 'bag', tmp_path / 'saved')
    assert 12_345 <= samples(tmp_path / 'saved') == saved.saved['/imu/data_raw'] < 20_000
    assert saved.seconds == pytest.approx((saved.saved.total() - 1) * 0.01)
    after = {path.name: path.read_bytes() for path in (tmp_path / 'bag').iterdir()}
    assert before == after


def test_on_a_full_disk_the_bag_up_to_then_can_be_read_at_once(tmp_path):
    """The limit of a file's size stands for it: 2.5 MB, in pieces of 1 MiB."""
    done = write(tmp_path / 'bag', limit=2_500_000)
    said, count = done.stdout.splitlines()
    assert 'cannot be written (File too large)' in said, done.stderr
    assert samples(tmp_path / 'bag') == int(count) > 4000
    with open_bag(tmp_path / 'bag') as reader:  # the metadata says the same
        assert reader.message_count == int(count)
        assert reader.duration == pytest.approx((int(count) - 1) * TICK, abs=1)


EVERYWHERE = """
import resource, sys
from pathlib import Path
from continuum_loc.errors import BagError
from continuum_loc.measurements import ImuSample
from msg_tools.bag import BagWriter, read_bag
import numpy as np
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
def write(name, limit):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        bag = BagWriter(Path(sys.argv[1]) / name)
        for k in range(1, 31):
            bag.write('imu/data_raw', ImuSample(k, 'a', np.zeros(3), np.zeros(3)))
            if k % 10 == 0:
                bag.flush()
        bag.close()
    except BagError:
        try:
            bag.close()
        except (BagError, OSError):
            pass
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    try:
        return sum(1 for _ in read_bag(Path(sys.argv[1]) / name))
    except BagError as error:
        return 0
assert write('whole', 10**6) == 30
size = next((Path(sys.argv[1]) / 'whole').glob('*.mcap')).stat().st_size
print(*[write(str(limit), limit) for limit in range(100, size + 100, 97)])
"""


def test_wherever_the_disk_fills_up_what_was_flushed_before_can_be_read(tmp_path):
    """Three pieces of ten messages, and a limit at each 97th byte of the file and of its index."""
    done = subprocess.run(
        [sys.executable, '-c', EVERYWHERE, str(tmp_path)], capture_output=True, text=True
    )
    counts = [int(word) for word in done.stdout.split()]
    assert set(counts) == {0, 10, 20, 30}, done.stderr
    assert counts == sorted(counts) and counts[-1] == 30
    assert counts.count(0) < len(counts) / 3


def test_a_disk_that_is_full_to_the_last_byte_gives_up_the_last_piece(tmp_path):
    """There is no room for the 50 bytes of an end until a record has been given up."""
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(1, 8):
            bag.write('imu/data_raw', ImuSample(k * TICK, 'a', np.full(3, float(k)), np.zeros(3)))
            bag.flush()
    file = next((tmp_path / 'bag').glob('*.mcap'))
    ends = [end for code, _, end, _ in records(file.open('rb')) if code == 6]
    code = (
        'import resource, sys; from pathlib import Path; from msg_tools.mcap import close_cut; '
        'limit = int(sys.argv[2]); resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)); '
        'close_cut(Path(sys.argv[1]))'
    )
    file.write_bytes(file.read_bytes()[: ends[4]])  # five pieces, and not a byte more
    done = subprocess.run(
        [sys.executable, '-c', code, str(file), str(ends[4])], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    assert samples(tmp_path / 'bag') == 4  # one file without metadata is a bag too


@pytest.fixture(scope='module', params=['', 'zstd'])
def whole(request, tmp_path_factory):
    """Write 3000 samples in chunks, packed or not, and a topic of a type of its own."""
    path = tmp_path_factory.mktemp('whole') / 'bag'
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if request.param:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('float64 grip\n', 'hand/msg/Grip'))
    from msg_tools.factory import bag_messages
    from msg_tools.topics import topic_spec

    with writer:
        imu = writer.add_connection('/imu/data_raw', 'sensor_msgs/msg/Imu', typestore=store)
        grip = writer.add_connection('/grip', 'hand/msg/Grip', typestore=store)
        for k in range(1, 3001):
            sample = ImuSample(k * TICK, 'a' * 800, np.full(3, float(k)), np.zeros(3))
            message = topic_spec('imu/data_raw').encode(bag_messages(), sample)
            writer.write(imu, k * TICK, store.serialize_cdr(message, imu.msgtype))
            if k % 100 == 0:
                value = store.types['hand/msg/Grip'](grip=float(k))
                writer.write(grip, k * TICK, store.serialize_cdr(value, grip.msgtype))
    return path


@pytest.mark.parametrize('share', [0.999, 0.9, 0.5, 0.2])
def test_a_bag_cut_anywhere_gives_its_messages_up_to_there(whole, share, tmp_path):
    shutil.copytree(whole, tmp_path / 'bag')
    file = next((tmp_path / 'bag').glob('*.mcap'))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    saved = repair(tmp_path / 'bag', tmp_path / 'saved')
    count = samples(tmp_path / 'saved')
    assert saved.saved == {'/imu/data_raw': count, '/grip': count // 100}
    plain = file.stat().st_size / share > 1_000_000
    # Unpacked messages are as many as the bytes; a packed chunk that is cut gives what it can.
    assert abs(count - 3000 * share) < 30 if plain else count > 0
    with open_bag(tmp_path / 'saved') as reader:
        grip = next(c for c in reader.connections if c.topic == '/grip')
        assert 'float64 grip' in grip.msgdef.data


def test_a_damaged_chunk_costs_its_own_messages_alone(whole, tmp_path):
    shutil.copytree(whole, tmp_path / 'bag')
    file = next((tmp_path / 'bag').glob('*.mcap'))
    data = bytearray(file.read_bytes())
    chunks = [
        (end - len(content), content)
        for code, content, end, _ in records(file.open('rb'))
        if code == 6
    ]
    assert len(chunks) >= 3
    begin, content = chunks[1]
    inside = slice(begin + 60, begin + len(content))
    data[inside] = os.urandom(len(content) - 60)
    file.write_bytes(data)
    saved = repair(file, tmp_path / 'saved')
    found = {item.stamp for _, item in read_bag(tmp_path / 'saved', topics=('imu/data_raw',))}
    assert 1800 < len(found) < 3000 and {TICK, 3000 * TICK} <= found
    assert 'damaged' in saved.lost[0]


def test_a_chunk_that_states_more_than_there_is_memory_is_damaged_and_no_bomb(tmp_path):
    import struct

    header = struct.pack('<QQQI', 0, 1, 2**60, 0) + struct.pack('<I', 4) + b'zstd'
    body = header + struct.pack('<Q', 8) + b'\x28\xb5\x2f\xfd\x00\x00\x00\x00'
    file = tmp_path / 'bomb.mcap'
    file.write_bytes(MAGIC + b'\x06' + struct.pack('<Q', len(body)) + body)
    survivors = Survivors(file)
    assert list(survivors) == [] and survivors.damaged == 1


def test_what_holds_no_message_is_named(tmp_path):
    (tmp_path / 'empty.mcap').touch()
    (tmp_path / 'text.mcap').write_text('not a bag, but long enough to hold a record or two')
    (tmp_path / 'folder').mkdir()
    for name, said in (
        ('empty.mcap', 'no whole message'),
        ('text.mcap', 'no whole message'),
        ('folder', 'no .mcap or .db3 file'),
        ('absent', 'no such bag'),
    ):
        with pytest.raises(BagError, match=said):
            repair(tmp_path / name, tmp_path / 'out')
        assert not (tmp_path / 'out').exists()


def test_several_files_of_one_recording_are_joined_in_their_order(tmp_path):
    (tmp_path / 'bag').mkdir()
    for number in (10, 2, 1):  # not in the order of their names as text
        with BagWriter(tmp_path / f'part{number}') as bag:
            at = {1: 0, 2: 1, 10: 2}[number]
            for k in range(100 * at + 1, 100 * at + 101):
                sample = ImuSample(k * TICK, 'a', np.full(3, float(k)), np.zeros(3))
                bag.write('imu/data_raw', sample)
        shutil.move(
            next((tmp_path / f'part{number}').glob('*.mcap')),
            tmp_path / 'bag' / f'b_{number}.mcap',
        )
    with pytest.raises(BagError, match='continuum-loc repair'):
        list(read_bag(tmp_path / 'bag'))
    repair(tmp_path / 'bag', tmp_path / 'saved')
    assert samples(tmp_path / 'saved') == 300


def test_the_command_says_how_much_was_saved_and_the_rest_is_unharmed(tmp_path):
    write(tmp_path / 'bag', flushed=1_000)
    done = subprocess.run(
        [sys.executable, '-m', 'continuum_loc.cli', 'repair', 'bag'],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
    )
    count = samples(tmp_path / 'bag_repaired')
    assert done.returncode == 0 and f'{count:,} messages' in done.stdout, done.stderr
