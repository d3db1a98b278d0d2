"""Bags, and lines of a driver: damaged, of foreign types, with values that no sensor gives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
import json
from pathlib import Path
import shutil
from typing import Any

from continuum_loc.errors import MessageError
from continuum_loc.measurements import (
    EncoderSample,
    ImuSample,
    NANOSECONDS,
    StrainSample,
    TofFrame,
)
from continuum_loc.robot import load_robot
from msg_tools.bag import BagWriter, read_bag
from msg_tools.factory import bag_messages, typestore
from msg_tools.topics import topic_of, topic_spec
import numpy as np
from studies._input_case import ANYTHING, Case, EITHER, READ, REFUSED

EPOCH = 1_700_000_000 * NANOSECONDS
CUTS, FLIPS = 8, 8
STORAGES = ('mcap', 'db3')


def wire_cases(seed: int) -> Iterator[Case]:
    """All bags and lines."""
    rng = np.random.default_rng(seed)
    yield from _whole_bags()
    yield from _damaged_bags(rng)
    yield from _odd_samples()
    yield from _lines()


# Bags


def samples(count: int = 40) -> list[Any]:
    """Make what an arm with four kinds of sensors records in 0.4 s."""
    found = []
    for tick in range(count):
        stamp = EPOCH + tick * NANOSECONDS // 100
        turn = np.array([0.1, -0.2, 0.001 * tick])
        found.append(ImuSample(stamp, 'ring1_imu', turn, np.array([0.0, 0.0, 9.81])))
        if tick % 7 == 0:
            ranges = 0.5 + 0.01 * tick + 0.001 * np.arange(64)
            points = np.column_stack([ranges, np.zeros((64, 2))])
            status = np.full(64, 5, np.uint8)
            found.append(TofFrame(stamp, 'ring1_tof1', points, ranges, np.full(64, 0.01), status))
        if tick % 10 == 0:
            s = np.array([0.1, 0.2])
            found.append(StrainSample(stamp, s, np.zeros(2), np.full(2, 0.5)))
            found.append(EncoderSample(stamp, ('insertion',), np.array([0.01]), np.array([0.0])))
    return found


def _bag(folder: Path, items: list[Any], storage: str = 'mcap') -> Path:
    """Write a bag; as db3 by the library itself, since we write MCAP alone."""
    path = folder / 'bag'
    if storage == 'mcap':
        with BagWriter(path) as writer:
            for item in items:
                writer.write(topic_of(item), item)
        return path
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for item in items:
            topic, spec = topic_of(item), topic_spec(topic_of(item))
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    f'/{topic}', spec.type, typestore=typestore()
                )
            message = spec.encode(bag_messages(), item)
            data = bytes(typestore().serialize_cdr(message, spec.type))
            writer.write(connections[topic], item.stamp, data)
    return path


def _read(path: Path) -> tuple[list[Any], list[MessageError]]:
    told: list[MessageError] = []
    items = [item for _, item in read_bag(path, on_error=lambda topic, error: told.append(error))]
    return items, told


def _judge(items: list[Any]) -> Callable[[tuple[list[Any], list[MessageError]]], str]:
    """Judge a bag: its samples in their order, and nothing missing that was not told."""

    def judge(read: tuple[list[Any], list[MessageError]]) -> str:
        found, told = read
        rest = iter(items)
        for item in found:
            if not any(_same(item, one) for one in rest):
                return f'a {type(item).__name__} at {item.stamp} that was not written'
        missing = len(items) - len(found)
        return '' if missing <= len(told) else f'{missing} missing, {len(told)} told'

    return judge


def _same(a: Any, b: Any) -> bool:
    """Whether two samples are equal, to the single precision that clouds have."""
    if type(a) is not type(b):
        return False
    for name in (item.name for item in fields(a)):
        one, other = getattr(a, name), getattr(b, name)
        if isinstance(one, np.ndarray) and one.dtype.kind == 'f':
            if one.shape != other.shape or not np.allclose(one, other, 1e-6, 0.0, equal_nan=True):
                return False
        elif not np.array_equal(one, other):
            return False
    return True


def _whole_bags() -> Iterator[Case]:
    for storage in STORAGES:
        items = samples()

        def write(folder: Path, storage: str = storage, items: list = items) -> Path:
            return _bag(folder, items, storage)

        yield Case('bag', f'{storage}, whole', write, _read, READ, _judge(items))

        def one_file(folder: Path, storage: str = storage, items: list = items) -> Path:
            return next(_bag(folder, items, storage).glob(f'*.{storage}'))

        yield Case('bag', f'{storage}, its file alone', one_file, _read, READ, _judge(items))


def _damaged_bags(rng: np.random.Generator) -> Iterator[Case]:
    items = samples()
    for storage in STORAGES:
        for share in rng.uniform(0.0, 1.0, CUTS):
            change = _changing(storage, lambda data, share=share: data[: int(share * len(data))])
            name = f'{storage}, cut at {100 * share:.1f} %'
            yield Case('bag', name, change, _read, EITHER, _judge(items))
        for number in range(FLIPS):
            change = _changing(storage, _flipping(int(rng.integers(2**31))))
            yield Case('bag', f'{storage}, bytes changed ({number})', change, _read, ANYTHING)
        empty = _changing(storage, lambda data: b'')
        yield Case('bag', f'{storage}, empty', empty, _read, REFUSED)
        text = _changing(storage, lambda data: b'not a bag')
        yield Case('bag', f'{storage}, a text', text, _read, REFUSED)
    for name, text in (
        ('no metadata', None),
        ('empty metadata', ''),
        ('metadata of another version', 'rosbag2_bagfile_information: {version: 99}\n'),
        ('metadata that names no file', 'rosbag2_bagfile_information: {version: 9}\n'),
        ('metadata 5,000 deep', '[' * 5000),
    ):
        yield Case('bag', name, _with_metadata(text), _read, EITHER, _judge(items))
    yield Case('bag', 'the file is gone', _without_file, _read, REFUSED)
    yield Case('bag', 'an empty folder', lambda folder: folder, _read, REFUSED)
    for name, topic, kind in (
        ('only foreign topics', '/chatter', 'std_msgs/msg/String'),
        ('our topic, foreign type', '/imu/data_raw', 'std_msgs/msg/String'),
    ):
        yield Case('bag', name, _foreign(topic, kind), _read, REFUSED)
    yield Case(
        'bag', 'one message of other bytes', _other_bytes, _read, EITHER, _judge(samples(8))
    )


def _changing(storage: str, change: Callable[[bytes], bytes]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = _bag(folder, samples(), storage)
        file = next(path.glob(f'*.{storage}'))
        file.write_bytes(change(file.read_bytes()))
        return path

    return write


def _flipping(seed: int) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        rng, damaged = np.random.default_rng(seed), bytearray(data)
        for place in rng.integers(0, len(data), 4):
            damaged[place] = rng.integers(256)
        return bytes(damaged)

    return change


def _with_metadata(text: str | None) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = _bag(folder, samples())
        metadata = path / 'metadata.yaml'
        metadata.unlink()
        if text is not None:
            metadata.write_text(text)
        return path

    return write


def _without_file(folder: Path) -> Path:
    path = _bag(folder, samples())
    next(path.glob('*.mcap')).unlink()
    return path


def _foreign(topic: str, kind: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        from rosbags.rosbag2 import StoragePlugin, Writer

        path = folder / 'bag'
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection(topic, kind, typestore=typestore())
            message = typestore().types[kind](data='hello')
            writer.write(connection, EPOCH, bytes(typestore().serialize_cdr(message, kind)))
        return path

    return write


def _other_bytes(folder: Path) -> Path:
    path = folder / 'bag'
    with BagWriter(path) as writer:
        for item in samples(8):
            writer.write(topic_of(item), item)
        writer.write_raw('imu/data_raw', b'\0\1\0\0' + b'junk', EPOCH + NANOSECONDS)
    return path


def _odd_samples() -> Iterator[Case]:
    """One sample that no sensor gives among others: told, or as it was written, never another."""
    good = samples(8)
    imu = good[0]
    nothing = np.full(3, np.nan)
    leaps = {
        '1970': 1,
        '2037': 2_114_380_800 * NANOSECONDS,
        'an hour ahead': EPOCH + 3600 * NANOSECONDS,
    }
    odd = {
        'nan in a gyro': replace(imu, angular_velocity=nothing),
        'infinity in an accelerometer': replace(imu, linear_acceleration=np.full(3, np.inf)),
        'a gyro of 1e300': replace(imu, angular_velocity=np.full(3, 1e300)),
        'nan in strain': StrainSample(imu.stamp, np.array([0.1]), np.zeros(1), np.full(1, np.nan)),
        'nan in an encoder': EncoderSample(
            imu.stamp, ('insertion',), np.full(1, np.nan), np.zeros(1)
        ),
        'an unknown sensor': replace(imu, sensor='nobody'),
        'a sensor without a name': replace(imu, sensor=''),
        'a sensor with a path as its name': replace(imu, sensor='../../etc/passwd'),
        **{f'a stamp of {name}': replace(imu, stamp=stamp) for name, stamp in leaps.items()},
    }
    for name, sample in odd.items():
        items = [*good[:4], sample, *good[4:]]

        def write(folder: Path, items: list = items) -> Path:
            path = folder / 'bag'
            with BagWriter(path) as writer:
                for k, item in enumerate(items):
                    writer.write(topic_of(item), item, EPOCH + k)
            return path

        yield Case('bag', name, write, _read, EITHER, _judge(items))

    def twice(folder: Path) -> Path:
        path = _bag(folder, good)
        shutil.copytree(path, folder / 'again')
        return folder / 'again'

    yield Case('bag', 'a copy of a bag', twice, _read, READ, _judge(good))


# Lines of a driver


NAN = float('nan')
FRAME = {
    'sensor': 'ring1_tof1',
    'distance_mm': [500] * 64,
    'target_status': [5] * 64,
    'stamp': 1.0,
}
TURN = {'sensor': 'ring1_imu', 'gyro_raw': [100, -200, 300], 'accel_raw': [0, 0, 8190]}
FIBRE = {'s': [0.1], 'strains': [[0.0, 0.0, 0.0]], 'stamp': 2.0}
BAD_FRAMES = {
    'status 261': {'target_status': [261] * 64},
    'status -1': {'target_status': [-1] * 64},
    'status 5.5': {'target_status': [5.5] * 64},
    'half a status': {'target_status': [5] * 63},
    '16 zones': {'distance_mm': [500] * 16, 'target_status': [5] * 16},
    'distance of nan': {'distance_mm': [NAN] * 64},
    'distance of infinity': {'distance_mm': [float('inf')] * 64},
    'distance of 70000 mm': {'distance_mm': [70_000] * 64},
    'distance of 400 digits': {'distance_mm': [10**400] * 64},
    'distance as a text': {'distance_mm': ['500'] * 64},
    'distance as truth': {'distance_mm': [True] * 64},
    'sigma of nan': {'range_sigma_mm': [NAN] * 64},
    'stamp in milliseconds': {'stamp': 1_700_000_000_123},
    'stamp in nanoseconds': {'stamp': 1_700_000_000_000_000_000},
    'negative stamp': {'stamp': -1.0},
    'stamp of nan': {'stamp': NAN},
    'stamp as a text': {'stamp': 'now'},
    'an unknown field': {'colour': 'red'},
    'a sensor that is a number': {'sensor': 7},
}
BAD_TURNS = {
    'gyro beyond 16 bits': {'gyro_raw': [65_530, 0, 0]},
    'gyro of nan': {'gyro_raw': [NAN, 0, 0]},
    'gyro of two axes': {'gyro_raw': [1, 2]},
    'gyro of a fraction': {'gyro_raw': [0.5, 0, 0]},
    'accelerometer beyond 16 bits': {'accel_raw': [0, 0, -40_000]},
    'no accelerometer': {'accel_raw': None},
}
BAD_FIBRES = {
    'strain of nan': {'strains': [[NAN, 0, 0]]},
    'strain of two cores': {'strains': [[0, 0]]},
    'strain of 200 %': {'strains': [[2.0, 0, 0]]},
    'more strains than stations': {'strains': [[0, 0, 0], [0, 0, 0]]},
}
BAD_LINES = {
    'no JSON': b'{"sensor": ',
    'a list': b'[1, 2]',
    'a number': b'7',
    'nothing known': b'{"temperature": 20}',
    'brackets 3,000 deep': b'[' * 3000 + b']' * 3000,
    'brackets 1,000,000 deep': b'[' * 1_000_000,
    'not UTF-8': b'\xff\xfe{}',
    'a field twice': json.dumps(TURN).encode().replace(b'{', b'{"sensor": "a", '),
    'a megabyte of one number': b'{"gyro_raw": ' + b'9' * 1_000_000 + b'}',
}


def _lines() -> Iterator[Case]:
    """Lines as a microcontroller writes them; each is to give its values, or a MessageError."""
    yield _line('a frame', FRAME, READ, _sees(0.5))
    empty = FRAME | {'target_status': [255] * 64}
    yield _line('a frame without a target', empty, READ, _sees(np.inf))
    nested = FRAME | {'distance_mm': [[500]] * 64}
    yield _line('a list of lists', nested, EITHER, _sees(0.5))
    yield _line('a turn', TURN, READ, _turns(100 * 0.0175))
    yield _line('a straight fibre', FIBRE, READ)
    for good, changes in ((FRAME, BAD_FRAMES), (TURN, BAD_TURNS), (FIBRE, BAD_FIBRES)):
        for name, change in changes.items():
            yield _line(name, good | change, REFUSED)
    for name, text in BAD_LINES.items():
        yield Case('line', name, lambda folder, text=text: text, sample_of, REFUSED)


def _line(
    name: str, reading: dict, right: str, judge: Callable[[Any], str] = lambda value: ''
) -> Case:
    text = json.dumps(reading).encode()
    return Case('line', name, lambda folder: text, sample_of, right, judge)


def _sees(distance: float) -> Callable[[TofFrame], str]:
    """Judge a frame at 1 s whose zones all see as far."""

    def judge(frame: TofFrame) -> str:
        right = np.isclose(frame.ranges, distance, rtol=1e-12).all()
        if frame.stamp == NANOSECONDS and right:
            return ''
        return f'stamp {frame.stamp}, ranges {frame.ranges.min()} to {frame.ranges.max()}'

    return judge


def _turns(degrees: float) -> Callable[[ImuSample], str]:
    def judge(sample: ImuSample) -> str:
        turn = float(np.degrees(sample.angular_velocity[0]))
        return '' if abs(turn - degrees) < 1e-9 else f'{turn} deg/s in place of {degrees}'

    return judge


def sample_of(line: bytes) -> TofFrame | ImuSample | StrainSample:
    """Make of a line what node `driver` makes of it."""
    from continuum_loc.nodes.support.readings import Readings
    from continuum_loc.nodes.support.settings import DriverNodeSettings

    readings = Readings(load_robot('engine'), DriverNodeSettings(), lambda: NANOSECONDS)
    return readings.sample(line)
