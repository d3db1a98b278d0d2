"""
Node `recorder`: the topics of the contract into a bag.

`ros2 bag` and `continuum-loc replay` read it.
"""

from __future__ import annotations

from collections import Counter
from datetime import datetime
from functools import partial
from pathlib import Path
from queue import Empty, Queue
import sys
import threading
import time
from typing import Any

from continuum_loc.errors import LiveError, SettingsError
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.quality import input_qos
from continuum_loc.nodes.support.runtime import run, write_summary
from continuum_loc.nodes.support.settings import RecorderNodeSettings
from msg_tools.bag import BagWriter, split_topic
from msg_tools.topics import FAMILIES, key_of, topic_spec, TOPICS
from rclpy.qos import DurabilityPolicy

# [s] trackers and rings are found on the graph: only the robot description names them before.
WATCH_PERIOD = 0.5
POLL = 0.1
MOST_TOPICS = 256
FLUSHED = 1.0  # s; what a recorder that is killed loses at most


class RecorderNode(PackageNode):
    """
    Callbacks queue serialised messages; one thread writes them.

    Where the disk is full the node ends with an error, and a bag of what came before.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder', RecorderNodeSettings(), **options)
        self.check_parameters()
        self.topics = self._wanted()
        self.dropped: Counter[str] = Counter()
        self._queue: Queue[tuple[str, bytes, int]] = Queue(self.settings.queue_messages)
        self._bytes_in = self._bytes_out = 0  # each counted by one thread
        self._stop = threading.Event()
        self._subscribed: set[str] = set()

    def activate(self) -> None:
        """Open a new bag, and hear what goes into it."""
        path = self.settings.bag or f'bag_{datetime.now():%Y%m%d_%H%M%S}'
        self.bag = BagWriter(path, self.get_namespace())
        self._stop.clear()
        writer = self.thread(self._write, 'writer')
        writer.start()
        self.undo(self._finish_bag, writer)
        self._subscribed.clear()
        for topic in self.topics:
            if topic not in FAMILIES:
                self._subscribe(topic)
        if FAMILIES.keys() & set(self.topics):
            self.every(WATCH_PERIOD, self._find_families)
        self.get_logger().info(f'recording {len(self._subscribed)} topics into {path}')

    def _finish_bag(self, writer: threading.Thread) -> None:
        """Write what is queued, and the bag's index; say what it holds."""
        self._stop.set()
        writer.join(timeout=60.0)
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

    def _find_families(self) -> None:
        for name, types in self.get_topic_names_and_types():
            split = split_topic(name, types[0])
            if (
                split is None
                or split[0] != self.get_namespace().strip('/')
                or key_of(split[1]) not in FAMILIES.keys() & set(self.topics)
            ):
                continue
            if split[1] not in self._subscribed and len(self._subscribed) < MOST_TOPICS:
                self._subscribe(split[1])

    def _receive(self, topic: str, data: bytes) -> None:
        if len(data) > self.settings.largest_message:
            self._drop(topic, f'messages of more than {self.settings.largest_message} bytes')
        elif self._bytes_in - self._bytes_out > self.settings.queue_bytes or self._queue.full():
            self._drop(topic, 'what comes faster than it can be written')
        else:
            self._bytes_in += len(data)
            self._queue.put((topic, data, self.now()))

    def _drop(self, topic: str, what: str) -> None:
        self.dropped[topic] += 1
        if self.dropped[topic] == 1:
            self.get_logger().warning(f'{topic}: {what} is dropped [the first; all are counted]')

    def _write(self) -> None:
        flushed = time.monotonic()
        while True:
            try:
                topic, data, stamp = self._queue.get(timeout=POLL)
            except Empty:
                if self._stop.is_set():
                    return
            else:
                self.bag.write_raw(topic, data, stamp)
                self._bytes_out += len(data)
            if time.monotonic() - flushed > FLUSHED:
                self.bag.flush()
                flushed = time.monotonic()


def record_for(seconds: float, bag: Path, namespace: str = '') -> None:
    """
    Record what a namespace says for some seconds; blocks meanwhile.

    Raises LiveError where that fails.
    """

    class Limited(RecorderNode):
        def activate(self) -> None:
            super().activate()
            self.every(seconds, self.finish)

    space = f'/{namespace.strip("/")}'
    code = run(Limited, ['--ros-args', '-p', f'bag:={bag}', '-r', f'__ns:={space}'])
    if code != 0:
        raise LiveError('the graph could not be recorded')


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(RecorderNode, args))


if __name__ == '__main__':
    main()
