"""
Bags in rosbag2's MCAP format, written and read without ROS; `ros2 bag` reads and writes the same.

with BagWriter("run1") as bag:
    bag.write("imu/data_raw", sample)
for topic, item in read_bag("run1"):
    ...
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from continuum_loc.errors import BagError, MessageError
from continuum_loc.measurements import NANOSECONDS
from continuum_loc.yaml_files import check_yaml
from msg_tools.factory import bag_messages, deserialize, typestore
from msg_tools.topics import cloud_topic_record, Topic, topic_spec, TOPICS, TRACKER

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

    namespace: put before every relative topic, as a robot's namespace would.
    """

    def __init__(self, path: str | Path, namespace: str = '') -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self.path = Path(path)
        if self.path.exists():
            raise BagError(f'{self.path}: exists already; give a new folder, or remove this one')
        self._root = f'/{namespace.strip("/")}/' if namespace.strip('/') else '/'
        self._connections: dict[str, Any] = {}
        self._stamps: dict[str, int] = {}
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        try:
            self._writer.open()
        except OSError as error:
            raise BagError(f'{self.path}: cannot be written ({error.strerror})') from None

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the bag's index. A bag that was not closed cannot be read."""
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
        connection = self._connections.get(topic) or self._connect(topic)
        self._writer.write(connection, stamp, data)

    def _connect(self, topic: str) -> Any:
        spec = topic_spec(topic)
        name = topic if topic.startswith('/') else self._root + topic
        self._connections[topic] = self._writer.add_connection(
            name, spec.type, typestore=typestore(), offered_qos_profiles=[_qos(spec)]
        )
        return self._connections[topic]


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
    path: str | Path, topics: tuple[str, ...] | None = None, namespace: str | None = None
) -> Iterator[tuple[str, int, bytes]]:
    """(relative topic, log time in ns, serialised message) of a bag, selected as by `read_bag`."""
    path = Path(path)
    with open_bag(path) as reader:
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
        reader = Reader(path)
        reader.open()
    except (
        Exception
    ) as error:  # damaged bytes come out of rosbags as all sorts of errors, MemoryError among them
        raise BagError(
            f'{path}: not a rosbag2 bag that can be read ({error or type(error).__name__}). '
            'Valid: a folder with metadata.yaml, or one .mcap or .db3 file, '
            'closed by its recorder; `mcap recover` mends a file that was cut off'
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def contract_topics(path: Path, connections: list, namespace: str | None) -> dict[str, str]:
    """Absolute topic -> relative topic of the contract, for those which belong to one robot."""
    found: dict[str, dict[str, str]] = {}
    for connection in connections:
        split = split_topic(connection.topic, connection.msgtype)
        if split is not None:
            found.setdefault(split[0], {})[connection.topic] = split[1]
    shared = found.pop('*', {})
    if namespace:
        return found.get(namespace.strip('/'), {}) | shared
    if len(found) > 1:
        raise BagError(
            f'{path}: holds several robots, choose one by its namespace: '
            + ', '.join(f"'{name}'" for name in sorted(found))
        )
    return next(iter(found.values()), {}) | shared


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
        key = TRACKER if parts[cut] + '/' == TRACKER and len(parts) - cut == 2 else relative
        if key in TOPICS and TOPICS[key].type == type_name:
            return '/'.join(parts[:cut]), relative
    return None


def _selected(topic: str, topics: tuple[str, ...] | None) -> bool:
    return topics is None or topic in topics or (TRACKER in topics and topic.startswith(TRACKER))


def _messages(path: Path, reader: Any, connections: list) -> Iterator[tuple[Any, int, bytes]]:
    try:
        yield from reader.messages(connections)
    except Exception as error:  # as in open_bag
        raise BagError(
            f'{path}: damaged ({error or type(error).__name__}); `mcap recover` may mend it'
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
