"""
Node `recorder`: the topics of the contract into a bag.

`ros2 bag` and `continuum-loc replay` read it.
"""

from __future__ import annotations

from collections import Counter, deque
from datetime import datetime
from functools import partial
import sys
import threading
import time
from typing import Any, NamedTuple

from continuum_loc.errors import SettingsError
from continuum_loc.nodes.support.runtime import input_qos, PackageNode, run, write_summary
from continuum_loc.nodes.support.settings import RecorderNodeSettings
from msg_tools.bag import BagWriter, split_topic
from msg_tools.topics import topic_spec, TOPICS, TRACKER
from rclpy.qos import DurabilityPolicy

# [s] trackers are found on the graph, as only the robot description could name them before.
WATCH_PERIOD = 0.5
POLL = 0.1
FLUSHED = 1.0  # s; what a recorder that is killed loses at most


class Received(NamedTuple):
    """A serialised message of a relative topic, and when it came [ns]."""

    topic: str
    data: bytes
    stamp: int


class Backlog:
    """What waits to be written: at most `messages` and `size` bytes of it."""

    def __init__(self, messages: int, size: int) -> None:
        self._most, self._size = (messages, size), 0
        self._waiting: deque[Received] = deque()
        self._ready = threading.Condition()

    def put(self, one: Received) -> bool:
        """Take a message in; False where there is no room for it."""
        messages, size = self._most
        with self._ready:
            if len(self._waiting) >= messages or self._size + len(one.data) > size:
                return False
            self._waiting.append(one)
            self._size += len(one.data)
            self._ready.notify()
            return True

    def take(self, timeout: float) -> Received | None:
        """Return the oldest message, or None when none came within `timeout` seconds."""
        with self._ready:
            if not self._waiting:
                self._ready.wait(timeout)
            if not self._waiting:
                return None
            one = self._waiting.popleft()
            self._size -= len(one.data)
            return one


class RecorderNode(PackageNode):
    """
    Callbacks queue serialised messages; one thread writes them.

    Where the disk is full the node ends with an error, and a bag of what came before.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder', RecorderNodeSettings(), **options)
        self.check_parameters()
        self.topics = self._wanted()
        path = self.settings.bag or f'bag_{datetime.now():%Y%m%d_%H%M%S}'
        self.bag = BagWriter(path, self.get_namespace())
        self.dropped: Counter[str] = Counter()
        self._backlog = Backlog(self.settings.queue_messages, self.settings.queue_bytes)
        self._stop = threading.Event()
        self._thread = self.thread(self._write, 'writer')
        self._thread.start()
        self._subscribed: set[str] = set()
        for topic in self.topics:
            if topic != TRACKER:
                self._subscribe(topic)
        if TRACKER in self.topics:
            self.create_timer(WATCH_PERIOD, self._find_trackers)
        self.get_logger().info(f'recording {len(self._subscribed)} topics into {path}')

    def close(self) -> None:
        """Write what is queued, and the bag's index; say what it holds."""
        self._stop.set()
        self._thread.join(timeout=60.0)
        try:
            self.bag.close()
        finally:
            written = dict(self.bag.counts)
            print(
                f'recorder: {self.bag.path} holds {sum(written.values())} messages, '
                f'{sum(self.dropped.values())} were dropped',
                file=sys.stderr,
            )
            write_summary(
                self.settings.summary_file,
                {'bag': str(self.bag.path), 'written': written, 'dropped': dict(self.dropped)},
            )

    def _wanted(self) -> list[str]:
        if self.settings.topics == ('all',):
            return list(TOPICS)
        unknown = [topic for topic in self.settings.topics if topic not in TOPICS]
        if unknown:
            raise SettingsError(
                f"parameter 'topics': no topic '{unknown[0]}' in the contract; valid: all, "
                + ', '.join(TOPICS)
            )
        return list(self.settings.topics)

    def _subscribe(self, topic: str) -> None:
        spec = topic_spec(topic)
        qos = input_qos(spec, self.settings.reliable_inputs)
        if spec.latched:
            # A latched message of before our start is only given to those who ask for it.
            qos = input_qos(spec, True)
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        self.listen(spec.type, topic, partial(self._receive, topic), qos, raw=True)
        self._subscribed.add(topic)

    def _find_trackers(self) -> None:
        for name, types in self.get_topic_names_and_types():
            split = split_topic(name, types[0])
            if (
                split is None
                or split[0] != self.get_namespace().strip('/')
                or not split[1].startswith(TRACKER)
            ):
                continue
            if split[1] not in self._subscribed:
                self._subscribe(split[1])

    def _receive(self, topic: str, data: bytes) -> None:
        if len(data) > self.settings.largest_message:
            self._drop(topic, f'messages of more than {self.settings.largest_message} bytes')
        elif not self._backlog.put(Received(topic, data, self.now())):
            self._drop(topic, 'what comes faster than it can be written')

    def _drop(self, topic: str, what: str) -> None:
        self.dropped[topic] += 1
        if self.dropped[topic] == 1:
            self.get_logger().warning(f'{topic}: {what} is dropped [the first; all are counted]')

    def _write(self) -> None:
        flushed = time.monotonic()
        while True:
            one = self._backlog.take(POLL)
            if one is not None:
                self.bag.write_raw(one.topic, one.data, one.stamp)
            elif self._stop.is_set():
                return
            if time.monotonic() - flushed > FLUSHED:
                self.bag.flush()
                flushed = time.monotonic()


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(RecorderNode, args))


if __name__ == '__main__':
    main()
