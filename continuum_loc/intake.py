"""
From messages to measurements that may be used.

A queue that degrades in a defined order, and rules for stamps.

Nothing here imports rclpy, so that all of it is tested without a graph.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
import heapq
import threading
import time
from typing import Any, NamedTuple

from continuum_loc.errors import MessageError
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    Measurement,
    NANOSECONDS,
    nanoseconds,
    StrainSample,
    TofFrame,
    TrackedPose,
)
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import live, Settings
from msg_tools.convert import strain_is_stamped
from msg_tools.topics import topic_spec, TRACKER
import numpy as np
from pydantic import Field

# What an overloaded node gives up first. IMU samples go last: they carry the motion between all
# others.
SACRIFICE = ('tof/points', 'strain', 'imu/mag', TRACKER, 'joint_states', 'imu/data_raw')


class IntakeSettings(Settings):
    """What a node that receives sensor data does with it before it is used."""

    reliable_inputs: bool = Field(
        False,
        description='ask publishers to resend lost messages; '
        'best-effort publishers are then not heard',
    )
    max_backlog: float = live(
        0.25, gt=0.0, description='queued ToF frames older than this are dropped, oldest first [s]'
    )
    queue_capacity: int = Field(
        4000,
        ge=100,
        description='most queued messages; beyond it ToF frames go first, then '
        'strain, fields, trackers, encoders, and IMU samples last',
    )
    future_tolerance: float = live(
        0.5, gt=0.0, description='a stamp farther ahead of the clock is refused [s]'
    )
    jump_tolerance: float = live(
        0.5,
        gt=0.0,
        description='stamps that leap farther than this are believed only when '
        'several agree: forward a gap, backward a new start [s]',
    )
    jump_confirmations: int = live(10, ge=1, description='how many samples must agree on a leap')


class Queued(NamedTuple):
    """
    A message as it arrived.

    Its place, topic, message, ROS time (ns) and monotonic time (s) of arrival.

    place: stamp (ns), or the arrival where the stamp is too far ahead of it, as stamps from the
    future must not hold up others; then the order of arrival.
    """

    place: tuple[int, int]
    topic: str
    message: Any
    arrival: int
    received: float

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
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def put(self, topic: str, message: Any, arrival: int) -> None:
        """Queue a message; older ones are dropped where the queue has grown too long."""
        kind = TRACKER if topic.startswith(TRACKER) else topic
        with self._ready:
            self.received[topic] += 1
            stamp = rough_stamp(message, arrival)
            ahead = stamp > arrival + nanoseconds(self.settings.future_tolerance)
            place = (arrival if ahead else stamp, self._order)
            self._queues[kind].append(Queued(place, topic, message, arrival, time.monotonic()))
            self._order += 1
            self._size += 1
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
            self._size -= 1
            return min(heads, key=lambda queue: queue[0].place).popleft()

    def clear(self) -> None:
        """Forget everything queued."""
        with self._ready:
            for queue in self._queues.values():
                queue.clear()
            self._size = 0

    def _relieve(self) -> None:
        frames = self._queues[SACRIFICE[0]]
        while frames and frames[-1].received - frames[0].received > self.settings.max_backlog:
            self._drop(SACRIFICE[0])
        while self._size > self.settings.queue_capacity:
            self._drop(next(name for name in SACRIFICE if self._queues[name]))

    def _drop(self, kind: str) -> None:
        self._queues[kind].popleft()
        self._size -= 1
        self.dropped[kind] += 1


class Early:
    """
    Messages that a simulated clock has not come to yet.

    /clock comes by a queue of its own, which reception may empty after those of the data, and at
    a high rate of play the tolerance of stamps is a very short time. So such a message waits until
    the clock has come near its stamp, but `patience` seconds of real time at most from when it was
    taken in.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
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
                heapq.heappush(self._by_stamp, (queued.stamp, queued.place[1]))
        return [one._replace(arrival=clock) for one in self._released(latest)] + free

    def _released(self, latest: int) -> list[Queued]:
        """Messages stamped up to `latest` (ns), and those that waited in vain."""
        free = []
        while self._by_stamp and (
            self._by_stamp[0][0] <= latest or self._by_stamp[0][1] not in self._waiting
        ):
            found = self._waiting.pop(heapq.heappop(self._by_stamp)[1], None)
            free += [] if found is None else [found[1]]
        before = time.monotonic() - self._patience
        while self._waiting and next(iter(self._waiting.values()))[0] < before:
            free.append(self._waiting.pop(next(iter(self._waiting)))[1])
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


class StampGate:
    """
    Rules for stamps.

    `judge` returns None to use a sample, or the class of error under which it is refused. A sample
    that follows the last one of its own sensor is late, however far the others are: after a pause
    of the whole process, reception takes one topic after the other. A leap from both is believed
    when `jump_confirmations` samples agree on it and none came meanwhile that does not leap:
    forward it is a gap, backward the data starts again (`restarts` counts those), as a looped bag
    does.
    """

    def __init__(self, settings: IntakeSettings) -> None:
        self.settings = settings
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next stamp starts anew."""
        self.newest: int | None = None
        self._leaping: deque[int] = deque(maxlen=4 * self.settings.jump_confirmations)
        self._seen: dict[str, deque[int]] = {}

    def judge(self, stamp: int, sensor: str, now: int) -> str | None:
        """`stamp`, `now` in ns; now = 0 while a simulated clock has not begun."""
        if stamp == 0:
            return 'zero stamp'
        if now and stamp > now + nanoseconds(self.settings.future_tolerance):
            return 'future stamp'
        if self._leaps(stamp, sensor) and not self._believed(stamp):
            return 'leap'
        self._leaping.clear()
        seen = self._seen.setdefault(sensor, deque(maxlen=64))
        if stamp in seen:
            return 'duplicate'
        seen.append(stamp)
        self.newest = stamp if self.newest is None else max(stamp, self.newest)
        return None

    def _leaps(self, stamp: int, sensor: str) -> bool:
        """Whether a stamp follows neither the newest of all nor the last of its own sensor."""
        known = [self.newest, *list(self._seen.get(sensor, ()))[-1:]]
        tolerance = nanoseconds(self.settings.jump_tolerance)
        return self.newest is not None and all(abs(stamp - one) > tolerance for one in known)

    def _believed(self, stamp: int) -> bool:
        tolerance = nanoseconds(self.settings.jump_tolerance)
        self._leaping.append(stamp)
        agreeing = sum(abs(other - stamp) <= tolerance for other in self._leaping)
        if agreeing < self.settings.jump_confirmations:
            return False
        if stamp < self.newest:
            self.reset()
            self.restarts += 1
        return True


class Intake:
    """Decodes, checks and counts. `report(kind, text)` is called once for each class of error."""

    def __init__(
        self,
        robot: RobotDescription,
        settings: IntakeSettings,
        report: Callable[[str, str], None],
        frame_prefix: str = '',
    ) -> None:
        self.robot, self.settings, self.frame_prefix = robot, settings, frame_prefix
        self.gate = StampGate(settings)
        self.used: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._report = report
        self._reported: set[str] = set()
        self._zones = robot.tof_model.rows * robot.tof_model.columns
        self._names = {
            TofFrame: _names(robot.tof),
            ImuSample: _names(robot.imu),
            FieldSample: _names(robot.hall),
            TrackedPose: _names(robot.sensors),
        }

    def accept(self, topic: str, message: Any, arrival: int) -> Measurement | None:
        """
        Return the measurement of a message, or None where it is refused.

        arrival: the clock when it came [ns], 0 while a simulated clock has not begun. A refusal is
        counted, and reported once for its class.
        """
        try:
            measurement = self._checked(topic, message, arrival)
            refusal = self.gate.judge(
                measurement.stamp, getattr(measurement, 'sensor', topic), arrival
            )
            if refusal:
                raise MessageError(
                    refusal,
                    f'{topic}: stamp {measurement.stamp / 1e9:.6f} s refused as {refusal} '
                    f'(newest {(self.gate.newest or 0) / 1e9:.6f} s, clock {arrival / 1e9:.6f} s)',
                )
        except MessageError as error:
            self.refuse(error.kind, str(error))
            return None
        self.used[topic] += 1
        return measurement

    def refuse(self, kind: str, text: str) -> None:
        """Count an error, and report the first of its class."""
        self.refused[kind] += 1
        if kind not in self._reported:
            self._reported.add(kind)
            self._report(kind, text)

    def _checked(self, topic: str, message: Any, arrival: int) -> Measurement:
        if (
            topic == 'strain'
            and not strain_is_stamped(message)
            and 'unstamped' not in self._reported
        ):
            self._reported.add('unstamped')
            self._report(
                'unstamped',
                'strain: data_offset is 0, so the arrival time has to serve as the stamp',
            )
        measurement = topic_spec(topic).decode(message, arrival, topic)
        measurement = self._without_prefix(measurement)
        names = self._names.get(type(measurement))
        if names is not None and measurement.sensor not in names:
            raise MessageError(
                'unknown frame',
                f"{topic}: robot '{self.robot.name}' has no such sensor "
                f"'{measurement.sensor}'; valid: {', '.join(names) or 'none of this kind'}",
            )
        self._check_content(topic, measurement)
        return measurement

    def _without_prefix(self, measurement: Any) -> Any:
        prefix = self.frame_prefix
        if prefix and getattr(measurement, 'sensor', '').startswith(prefix):
            return replace(measurement, sensor=measurement.sensor.removeprefix(prefix))
        return measurement

    def _check_content(self, topic: str, measurement: Measurement) -> None:
        if isinstance(measurement, TofFrame) and len(measurement.ranges) != self._zones:
            raise MessageError(
                'zones',
                f"{topic}: {len(measurement.ranges)} zones of '{measurement.sensor}'; the "
                f'robot description says {self._zones}',
            )
        if isinstance(measurement, StrainSample):
            self._check_stations(topic, measurement.s)
        if isinstance(measurement, EncoderSample) and 'insertion' in measurement.names:
            travel = measurement.position[measurement.names.index('insertion')]
            if not np.isfinite(travel):
                raise MessageError(
                    'value', f"{topic}: the position of joint 'insertion' is {travel}"
                )

    def _check_stations(self, topic: str, s: np.ndarray) -> None:
        if self.robot.strain is None:
            raise MessageError(
                'unknown frame', f"{topic}: robot '{self.robot.name}' has no strain sensor"
            )
        if s.min() < -1e-6 or s.max() > self.robot.length + 1e-6 or (np.diff(s) <= 0.0).any():
            raise MessageError(
                'value',
                f'{topic}: stations s must rise within 0 to {self.robot.length} m, got '
                f'{s.min():.4g} to {s.max():.4g}',
            )


def _names(sensors: tuple) -> tuple[str, ...]:
    return tuple(sensor.name for sensor in sensors)
