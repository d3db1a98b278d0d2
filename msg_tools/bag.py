"""
Bags in rosbag2's MCAP format, written and read without ROS; `ros2 bag` reads and writes the same.

with BagWriter("run1") as bag:
    bag.write("imu/data_raw", sample)
for topic, item in read_bag("run1"):
    ...
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
import re
from typing import Any

from continuum_loc.errors import BagError, MessageError
from continuum_loc.measurements import NANOSECONDS
from continuum_loc.yaml_files import check_yaml
from msg_tools.factory import bag_messages, deserialize, typestore
from msg_tools.mcap import close_cut
from msg_tools.topics import cloud_topic_record, INPUTS, key_of, Topic, topic_spec, TOPICS

BAG_SUFFIXES = ('.mcap', '.db3')
_CLOUDS = ('reconstruction', 'prior_map')


def _qos(topic: Topic) -> Any:
    """Return the QoS that our publishers offer: reliable, and kept for late joiners if latched."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(2147483647, 4294967295)
    durability = QosDurability.TRANSIENT_LOCAL if topic.latched else QosDurability.VOLATILE
    return Qos(
        QosHistory.KEEP_LAST,
        topic.depth,
        QosReliability.RELIABLE,
        durability,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


class BagWriter:
    """
    Writes a bag folder at `path` (which must not exist); use it as a context manager.

    namespace: put before every relative topic, as a robot's namespace would. Raises BagError where
    it cannot be written, as on a full disk; `close` then saves what was written before, and
    `counts` says how many messages of each topic that is.
    """

    def __init__(self, path: str | Path, namespace: str = '') -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self.path = Path(path)
        if self.path.exists():
            raise BagError(f'{self.path}: exists already; give a new folder, or remove this one')
        self._root = f'/{namespace.strip("/")}/' if namespace.strip('/') else '/'
        self.counts: Counter[str] = Counter()
        self._connections: dict[str, Any] = {}
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._cut = False
        with self._failing():
            self._writer.open()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the bag's index: one that was not closed has to be repaired before it is read."""
        try:
            if not self._cut:
                with self._failing():
                    self._writer.close()
        finally:
            if self._cut and self._writer.storage is not None:
                self._save()

    def flush(self) -> None:
        """Hand what was written to the system, so that it outlives the process."""
        storage = self._writer.storage
        with self._failing():
            if storage.chunk.bio.tell():
                storage.close_chunk()
            storage.bio.flush()

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._cut = True
            raise BagError(f'{self.path}: cannot be written ({error.strerror})') from None

    def _save(self) -> None:
        """End the file after the last whole piece of it, and write metadata of what it holds."""
        storage = self._writer.storage
        with suppress(OSError):  # it still tries to write what it could not
            storage.bio.close()
        with self._failing():
            close_cut(storage.path)
        with open_bag(storage.path) as reader:
            left = {c.topic: c.msgcount for c in reader.connections}
            self._writer.max_timestamp = reader.end_time - 1
        for topic, connection in self._connections.items():
            self.counts[topic] = left.get(connection.topic, 0)
            self._writer.counts[connection.id] = self.counts[topic]
        self._writer.storage = _Closed(storage.path)
        with suppress(OSError):  # one file without metadata can be read too
            self._writer.close()

    def write(self, topic: str, item: Any, stamp: int | None = None) -> None:
        """
        Write a measurement, truth, `Estimate`, map or record to a topic of the contract.

        stamp: integer ns under which the bag logs it; by default the item's own. A map has none:
        give it.
        """
        stamp = item.stamp if stamp is None else stamp
        spec = topic_spec(topic)
        item = cloud_topic_record(item, stamp) if topic in _CLOUDS else item
        message = spec.encode(bag_messages(), item)
        self.write_raw(topic, bytes(typestore().serialize_cdr(message, spec.type)), stamp)

    def write_raw(self, topic: str, data: bytes, stamp: int) -> None:
        """
        Write an already serialised message of a topic of the contract.

        CDR with its 4-byte head.
        """
        with self._failing():
            connection = self._connections.get(topic) or self._connect(topic)
            self._writer.write(connection, stamp, data)
        self.counts[topic] += 1

    def _name(self, topic: str) -> str:
        return topic if topic.startswith('/') else self._root + topic

    def _connect(self, topic: str) -> Any:
        spec = topic_spec(topic)
        self._connections[topic] = self._writer.add_connection(
            self._name(topic), spec.type, typestore=typestore(), offered_qos_profiles=[_qos(spec)]
        )
        return self._connections[topic]


@dataclass(frozen=True)
class _Closed:
    """What stands for a file that has its end already."""

    path: Path

    def close(self, version: int, metadata: str) -> None:
        """Nothing is left to write."""


def read_bag(
    path: str | Path,
    topics: tuple[str, ...] | None = None,
    namespace: str | None = None,
    on_error: Callable[[str, MessageError], None] | None = None,
) -> Iterator[tuple[str, Any]]:
    """
    (relative topic, measurement, truth or record) of a bag, in the order of the log.

    The bag is a folder or a file.

    topics: only these (`tracker/` for all trackers). namespace: whose topics, where several robots
    are in the bag; None or empty takes the only one.
    on_error: told about each message that cannot be used, which is then left out; without it the
    first one raises. Raises BagError naming the file, and what is valid.
    """
    for topic, arrival, data in raw_messages(path, topics, namespace):
        try:
            yield topic, _decode(topic, data, arrival)
        except MessageError as error:
            if on_error is None:
                raise BagError(
                    f'{path}: {error} (logged at {arrival / NANOSECONDS:.6f} s)'
                ) from None
            on_error(topic, error)


def raw_messages(
    path: str | Path,
    topics: tuple[str, ...] | None = None,
    namespace: str | None = None,
    mistyped: Callable[[str, int, str], None] = lambda topic, count, text: None,
) -> Iterator[tuple[str, int, bytes]]:
    """
    (relative topic, log time in ns, serialised message) of a bag, selected as by `read_bag`.

    mistyped: told of inputs by name that are of another type, which are left out.
    """
    path = Path(path)
    with open_bag(path) as reader:
        for stranger in _mistyped(reader.connections, namespace):
            mistyped(*stranger)
        names = contract_topics(path, reader.connections, namespace)
        wanted = [
            c for c in reader.connections if c.topic in names and _selected(names[c.topic], topics)
        ]
        if not wanted:
            raise BagError(
                f'{path}: nothing to read; topics in it: {_listing(reader.connections)}'
            )
        for connection, arrival, data in _messages(path, reader, wanted):
            yield names[connection.topic], arrival, data


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """
    Open a rosbags reader.

    Raises BagError naming the file.
    """
    from rosbags.rosbag2 import Reader

    if not path.exists():
        raise BagError(
            f'{path}: no such bag; give a bag folder (with metadata.yaml), '
            'or an .mcap or .db3 file'
        )
    try:
        if (metadata := path / 'metadata.yaml').is_file():
            check_yaml(metadata)
        reader = Reader(_storage_of(path))
        reader.open()
    except (
        Exception
    ) as error:  # damaged bytes come out of rosbags as all sorts of errors, MemoryError among them
        raise BagError(
            f'{path}: not a rosbag2 bag that can be read ({error or type(error).__name__}). '
            'Valid: a folder with metadata.yaml, or one .mcap or .db3 file, closed by its '
            'recorder; `continuum-loc repair` (or `mcap recover`) mends one that was cut off'
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def _storage_of(path: Path) -> Path:
    """Take the bag itself, or its one file where a killed recorder left no metadata."""
    files = storage_files(path)
    whole = path.is_file() or (path / 'metadata.yaml').is_file()
    return path if whole or len(files) != 1 else files[0]


def storage_files(path: Path) -> list[Path]:
    """List the files of a bag that hold messages, in the order in which they were written."""
    if path.is_file():
        return [path]
    found = [one for one in path.iterdir() if one.suffix in BAG_SUFFIXES]
    return sorted(found, key=lambda one: [int(n) for n in re.findall(r'\d+', one.stem)[-1:]])


def contract_topics(path: Path, connections: list, namespace: str | None) -> dict[str, str]:
    """
    Absolute topic -> relative topic of the contract, for those which belong to one robot.

    namespace: the robot's; `/` for the one without; None or empty for the only one. Raises
    BagError listing them where that does not tell.
    """
    found: dict[str, dict[str, str]] = {}
    for connection in connections:
        split = split_topic(connection.topic, connection.msgtype)
        if split is not None:
            found.setdefault(split[0], {})[connection.topic] = split[1]
    shared = found.pop('*', {})
    if not namespace and len(found) < 2:
        return next(iter(found.values()), {}) | shared
    if namespace and namespace.strip('/') in found:
        return found[namespace.strip('/')] | shared
    listed = ', '.join(f"'{name or '/'}'" for name in sorted(found)) or 'none'
    said = f"no robot '{namespace}' in it" if namespace else 'holds several robots'
    raise BagError(f'{path}: {said}; choose one by its namespace: {listed}')


def _mistyped(connections: list, namespace: str | None) -> Iterator[tuple[str, int, str]]:
    """
    Find inputs of one robot by name that are none by type.

    Yields (relative topic, how many messages, what is wrong).
    """
    root = f'/{namespace.strip("/")}/' if namespace and namespace.strip('/') else '/'
    for c in connections:
        name = next((name for name in INPUTS if c.topic.endswith(f'/{name}')), '')
        if name and c.topic.startswith(root) and c.msgtype != TOPICS[name].type:
            expected = TOPICS[name].type
            yield name, c.msgcount, f'{c.topic}: of type {c.msgtype}; the contract says {expected}'


def split_topic(name: str, type_name: str) -> tuple[str, str] | None:
    """
    (namespace, relative topic) of an absolute name, or None outside the contract.

    '*' owns the absolute topics.
    """
    if name in TOPICS:
        return ('*', name) if TOPICS[name].type == type_name else None
    parts = name.strip('/').split('/')
    for cut in range(len(parts)):
        relative = '/'.join(parts[cut:])
        key = key_of(relative)
        if key in TOPICS and TOPICS[key].type == type_name:
            return '/'.join(parts[:cut]), relative
    return None


def _selected(topic: str, topics: tuple[str, ...] | None) -> bool:
    return topics is None or topic in topics or key_of(topic) in topics


def _messages(path: Path, reader: Any, connections: list) -> Iterator[tuple[Any, int, bytes]]:
    try:
        yield from reader.messages(connections)
    except Exception as error:  # as in open_bag
        raise BagError(
            f'{path}: damaged ({error or type(error).__name__}); `continuum-loc repair` (or '
            '`mcap recover`) saves what is whole'
        ) from None


def _decode(topic: str, data: bytes, arrival: int) -> Any:
    type_name = topic_spec(topic).type
    try:
        message = deserialize(data, type_name)
    except Exception as error:  # rosbags states no closed set of errors for damaged bytes
        raise MessageError(
            'bytes', f'{topic}: not a {type_name} ({type(error).__name__}: {error})'
        ) from None
    return topic_spec(topic).decode(message, arrival, topic)


def _listing(connections: list) -> str:
    return ', '.join(f'{c.topic} ({c.msgtype})' for c in connections) or 'none'
