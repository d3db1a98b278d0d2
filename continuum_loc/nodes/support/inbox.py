"""
The queue between reception and estimation, which degrades in a defined order.

Nothing here imports rclpy, so that it is tested without a graph.
"""

from __future__ import annotations

from collections import Counter, deque
import heapq
import threading
import time
from typing import Any, NamedTuple

from continuum_loc.intake import IntakeSettings
from continuum_loc.measurements import NANOSECONDS, nanoseconds
from msg_tools.convert import strain_is_stamped
from msg_tools.topics import TRACKER
import numpy as np

# What an overloaded node gives up first. IMU samples go last: they carry the motion between all
# others.
SACRIFICE = (
    'tof/points',
    'strain',
    'imu/mag',
    TRACKER,
    'joint_states',
    'base/odom',
    'base/pose',
    'imu/data_raw',
)


class Queued(NamedTuple):
    """
    A message as it arrived.

    Its place, topic, message, ROS time (ns) and monotonic time (s) of arrival, and bytes.

    place: stamp (ns), or the arrival where the stamp is too far ahead of it, as stamps from the
    future must not hold up others; then the order of arrival.
    """

    place: tuple[int, int]
    topic: str
    message: Any
    arrival: int
    received: float
    size: int

    @property
    def stamp(self) -> int:
        """As far as it is known before it is checked [ns]."""
        return rough_stamp(self.message, self.arrival)


class Inbox:
    """
    The queue between reception (one thread puts) and estimation (one thread takes).

    Each topic keeps its order of arrival; topics are merged by stamp, because reception takes them
    one after the other, and a backlog would otherwise tear them apart.
    """

    def __init__(self, settings: IntakeSettings) -> None:
        self.settings = settings
        self.received: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._queues: dict[str, deque[Queued]] = {name: deque() for name in SACRIFICE}
        self._ready = threading.Condition()
        self._order = 0
        self._size = self._bytes = 0

    def __len__(self) -> int:
        return self._size

    def put(self, topic: str, message: Any, arrival: int, size: int = 0) -> None:
        """Queue a message of `size` bytes; older ones are dropped where there are too many."""
        kind = TRACKER if topic.startswith(TRACKER) else topic
        with self._ready:
            self.received[topic] += 1
            stamp = rough_stamp(message, arrival)
            ahead = stamp > arrival + nanoseconds(self.settings.future_tolerance)
            place = (arrival if ahead else stamp, self._order)
            queued = Queued(place, topic, message, arrival, time.monotonic(), size)
            self._queues[kind].append(queued)
            self._order += 1
            self._size += 1
            self._bytes += size
            self._relieve()
            self._ready.notify()

    def take(self, timeout: float) -> Queued | None:
        """Return the message whose turn it is, or None when none came within `timeout` seconds."""
        with self._ready:
            if self._size == 0:
                self._ready.wait(timeout)
            heads = [queue for queue in self._queues.values() if queue]
            if not heads:
                return None
            taken = min(heads, key=lambda queue: queue[0].place).popleft()
            self._size -= 1
            self._bytes -= taken.size
            return taken

    def clear(self) -> None:
        """Forget everything queued."""
        with self._ready:
            for queue in self._queues.values():
                queue.clear()
            self._size = self._bytes = 0

    def _relieve(self) -> None:
        frames = self._queues[SACRIFICE[0]]
        while frames and frames[-1].received - frames[0].received > self.settings.max_backlog:
            self._drop(SACRIFICE[0])
        limits = self.settings
        while self._size > limits.queue_capacity or self._bytes > limits.queue_bytes:
            self._drop(next(name for name in SACRIFICE if self._queues[name]))

    def _drop(self, kind: str) -> None:
        self._bytes -= self._queues[kind].popleft().size
        self._size -= 1
        self.dropped[kind] += 1


class Early:
    """
    Messages that a simulated clock has not come to yet.

    /clock comes by a queue of its own, which reception may empty after those of the data, and at
    a high rate of play the tolerance of stamps is a very short time. So such a message waits until
    the clock has come near its stamp, but `patience` seconds of real time at most from when it was
    taken in, and only while all that wait have at most `most` bytes.
    """

    def __init__(self, patience: float, most: int = 64_000_000) -> None:
        self._patience, self._most, self._bytes = patience, most, 0
        self._waiting: dict[int, tuple[float, Queued]] = {}  # since when, by order of arrival
        self._by_stamp: list[tuple[int, int]] = []  # a heap of (stamp, order of arrival)

    def __len__(self) -> int:
        return len(self._waiting)

    def timely(self, new: list[Queued], clock: int, tolerance: float) -> list[Queued]:
        """
        Take messages in; give up those that may be judged, at `clock` (ns) and a tolerance [s].

        Those that waited come first, by stamp, and count as having come just now. A message that
        its own arrival does not make early never waits: a looped bag's clock jumps back.
        """
        free = []
        latest = clock + nanoseconds(tolerance)
        for queued in new:
            if not queued.arrival or queued.stamp <= queued.arrival + nanoseconds(tolerance):
                free.append(queued)
            else:
                self._waiting[queued.place[1]] = time.monotonic(), queued
                self._bytes += queued.size
                heapq.heappush(self._by_stamp, (queued.stamp, queued.place[1]))
        return [one._replace(arrival=clock) for one in self._released(latest)] + free

    def _released(self, latest: int) -> list[Queued]:
        """Messages stamped up to `latest` (ns), and those that waited in vain."""
        free = []
        while self._by_stamp and (
            self._by_stamp[0][0] <= latest or self._by_stamp[0][1] not in self._waiting
        ):
            order = heapq.heappop(self._by_stamp)[1]
            free += [self._waiting.pop(order)[1]] if order in self._waiting else []
        before = time.monotonic() - self._patience
        held = self._bytes - sum(one.size for one in free)
        while self._waiting and (
            next(iter(self._waiting.values()))[0] < before or held > self._most
        ):
            free.append(self._waiting.pop(next(iter(self._waiting)))[1])
            held -= free[-1].size
        self._bytes = held
        return free


def rough_stamp(message: Any, arrival: int) -> int:
    """Read the stamp (ns) of a message that was not checked yet: good enough to sort by."""
    header = getattr(message, 'header', None)
    if header is not None:
        return header.stamp.sec * NANOSECONDS + header.stamp.nanosec
    data = getattr(message, 'data', None)
    if data is not None and strain_is_stamped(message) and len(data) and np.isfinite(data[0]):
        return nanoseconds(data[0])
    return arrival
