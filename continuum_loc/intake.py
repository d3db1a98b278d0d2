"""
The one gate between messages and an estimator: what may be used, at which stamp, and what not.

A live node and a replay pass it alike; a replay's clock is the log of its bag, so that the same
bag gives the same. What a message has to be in itself is checked where it is decoded
(`msg_tools`), what it has to be for this robot and at this time is checked here, and nowhere else.
Nothing here imports rclpy.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
import threading
from typing import Any, TypeVar

from continuum_loc.errors import MeasurementError, MessageError
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    Measurement,
    NANOSECONDS,
    nanoseconds,
    StrainSample,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import live, Settings
from msg_tools.convert import strain_is_stamped
from msg_tools.topics import topic_spec
import numpy as np
from pydantic import Field

T = TypeVar('T')
LEAP_SPAN = 50_000_000  # ns
RESTARTS_TOLD = 10  # the others are only counted
END = 1e-6  # m; how far beyond the body's ends a station may be by rounding


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
    queue_bytes: int = Field(
        64_000_000, ge=100_000, description='most queued bytes; beyond it the same go first'
    )
    largest_message: int = Field(
        1_000_000, ge=1_000, description='a longer message is refused undecoded [bytes]'
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
    longest_gap: float = live(
        5.0, gt=0.0, description='after a longer gap the data starts anew, too [s]'
    )


class StampGate:
    """
    Rules for stamps.

    `judge` returns None to use a sample, or the class of error under which it is refused. A sample
    that follows the last one of its own sensor is late, however far the others are: after a pause
    of the whole process, reception takes one topic after the other. A leap from both is believed
    when `jump_confirmations` samples agree on it, for LEAP_SPAN of their time (the frames of one
    cycle may share a clock of their own), and none came meanwhile that does not leap. Then it is
    a gap, which a motion prior bridges; but backward, as a looped bag leaps, or forward over more
    than `longest_gap`, the data starts again, which `restarts` counts.
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
        """Whether enough leaping samples follow one another here, and not at one instant alone."""
        self._leaping.append(stamp)
        tolerance = nanoseconds(self.settings.jump_tolerance)
        ordered = sorted(self._leaping)
        low = high = ordered.index(stamp)
        while low > 0 and ordered[low] - ordered[low - 1] <= tolerance:
            low -= 1
        while high < len(ordered) - 1 and ordered[high + 1] - ordered[high] <= tolerance:
            high += 1
        if (
            high - low + 1 < self.settings.jump_confirmations
            or ordered[high] - ordered[low] < LEAP_SPAN
        ):
            return False
        if not 0 <= stamp - self.newest <= nanoseconds(self.settings.longest_gap):
            self.reset()
            self.restarts += 1
        return True


class Intake:
    """
    Decodes, checks and counts.

    report(kind, text): called once for each class of error, and at each new start of the data.
    restart: called before the first sample of such a start is given out, and after a failure, for
    the estimator to forget the past. strict: the first that is refused raises its MessageError.
    frame_prefix: what the robot's frames are called on the graph, before their names.

    received, used: by topic. refused: by class of error. refusals: the number, and the first text,
    by topic and class. tof_status: (256,) zones of each status in the frames used.
    """

    def __init__(
        self,
        robot: RobotDescription,
        settings: IntakeSettings | None = None,
        report: Callable[[str, str], None] = lambda kind, text: None,
        frame_prefix: str = '',
        restart: Callable[[], None] = lambda: None,
        strict: bool = False,
    ) -> None:
        self.robot, self.frame_prefix = robot, frame_prefix
        self.settings = settings or IntakeSettings()
        self.gate = StampGate(self.settings)
        self.restart, self.strict = restart, strict
        self.received: Counter[str] = Counter()
        self.used: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.refusals: dict[tuple[str, str], tuple[int, str]] = {}
        self.failures = 0
        self.tof_status = np.zeros(256, np.int64)
        self._report = report
        self._reported: set[str] = set()
        self._counting = threading.Lock()  # reception refuses too
        self._zones = robot.tof_model.rows * robot.tof_model.columns
        self._names = {
            TofFrame: _names(robot.tof),
            ImuSample: _names(robot.imu),
            FieldSample: _names(robot.hall),
            TrackedPose: _names(robot.sensors),
        }

    def parse(self, topic: str, data: bytes, read: Callable[[bytes, str], Any]) -> Any | None:
        """
        Deserialise a message by `read(data, type name)`, unless it is too long to be one.

        None where it is refused.
        """
        kind, most = topic_spec(topic).type, self.settings.largest_message
        try:
            if len(data) <= most:
                return read(data, kind)
            wrong = 'size', f'{topic}: a message of {len(data)} bytes; valid: {most}'
        except Exception as error:  # libraries state no closed set of errors for damaged bytes
            said = f'{type(error).__name__}: {str(error)[:100]}'
            wrong = 'bytes', f'{topic}: not a {kind} ({said})'
        self.received[topic] += 1
        self.refuse(*wrong, topic)
        return None

    def accept(self, topic: str, message: Any, arrival: int) -> Measurement | None:
        """
        Return the measurement (or truth) of a message, or None where it is refused.

        arrival: the clock when it came [ns], 0 while a simulated clock has not begun. A refusal is
        counted, and reported once for its class.
        """
        try:
            self._check_header(topic, message)
            sample = topic_spec(topic).decode(message, arrival, topic)
        except MessageError as error:
            self.received[topic] += 1
            self.refuse(error.kind, str(error), topic)
            return None
        return self.admit(topic, sample, arrival)

    def admit(self, topic: str, sample: Any, arrival: int) -> Measurement | None:
        """Do as `accept` for a sample that is decoded already."""
        self.received[topic] += 1
        sample = self._without_prefix(sample)
        try:
            self.check(topic, sample)
            if not isinstance(sample, TruthSample):  # which no estimator hears
                self._check_stamp(topic, sample, arrival)
        except MessageError as error:
            self.refuse(error.kind, str(error), topic)
            return None
        self.used[topic] += 1
        if isinstance(sample, TofFrame):
            self.tof_status += np.bincount(sample.status, minlength=256)
        return sample

    def attempt(self, action: Callable[[], T], what: str) -> T | None:
        """
        Do `action` on what came from `what`.

        A measurement that cannot be used is refused. Any other failure is counted, and the
        estimate starts anew.
        """
        try:
            return action()
        except MeasurementError as error:
            self.refuse(error.reason, f'{what}: {error}', what)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            self.failures += 1
            said = f'{type(error).__name__}: {error}'
            self.refuse('failure', f'the estimator failed on {what}, starting anew ({said})', what)
            self.restart()
        return None

    def refuse(self, kind: str, text: str, topic: str = '', count: int = 1) -> None:
        """Count an error, and report the first of its class."""
        if self.strict:
            raise MessageError(kind, text)
        with self._counting:
            self.refused[kind] += count
            before, first = self.refusals.get((topic, kind), (0, text))
            self.refusals[topic, kind] = before + count, first
        self._tell(kind, text)

    def counts(self) -> dict[str, Any]:
        """Give all that was counted, as a summary file holds it."""
        refusals: dict[str, dict[str, Any]] = {}
        for (topic, kind), (count, first) in sorted(self.refusals.items()):
            refusals.setdefault(topic, {})[kind] = {'count': count, 'first': first}
        return {
            'received': dict(self.received),
            'used': dict(self.used),
            'refused': dict(self.refused),
            'refusals': refusals,
            'restarts': self.gate.restarts,
            'failures': self.failures,
            'tof_status': {
                str(code): int(self.tof_status[code]) for code in np.flatnonzero(self.tof_status)
            },
        }

    def check(self, topic: str, sample: Any) -> None:
        """Raise MessageError where a decoded sample is none of this robot's."""
        names = self._names.get(type(sample))
        if names is not None and sample.sensor not in names:
            raise MessageError(
                'unknown frame',
                f"{topic}: robot '{self.robot.name}' has no such sensor "
                f"'{sample.sensor[:80]}'; valid: {', '.join(names) or 'none of this kind'}",
            )
        if isinstance(sample, TofFrame):
            self._check_zones(topic, len(sample.ranges))
        elif isinstance(sample, StrainSample):
            self._check_stations(topic, sample.s)
        elif isinstance(sample, EncoderSample) and 'insertion' in sample.names:
            travel = sample.position[sample.names.index('insertion')]
            if not np.isfinite(travel):
                raise MessageError(
                    'value', f"{topic}: the position of joint 'insertion' is {travel}"
                )
        elif isinstance(sample, BaseSample):
            self._check_base(topic, sample.frame)
        elif isinstance(sample, TruthSample):
            self._check_truth(topic, len(sample.T_map_ring))

    def _check_header(self, topic: str, message: Any) -> None:
        """Refuse what is too much to be decoded, and tell that a stamp has to be made up."""
        if topic == 'tof/points' and message.width * message.height > self._zones:
            self._check_zones(topic, message.width * message.height)
        if topic == 'strain' and not strain_is_stamped(message):
            text = 'strain: data_offset is 0, so the arrival time has to serve as the stamp'
            self._tell('unstamped', text)

    def _check_zones(self, topic: str, zones: int) -> None:
        if zones != self._zones:
            raise MessageError(
                'zones', f'{topic}: {zones} zones; the robot description says {self._zones}'
            )

    def _check_stations(self, topic: str, s: np.ndarray) -> None:
        if self.robot.strain is None:
            raise MessageError(
                'unknown frame', f"{topic}: robot '{self.robot.name}' has no strain sensor"
            )
        if s.min() < -END or s.max() > self.robot.length + END or (np.diff(s) <= 0.0).any():
            raise MessageError(
                'value',
                f'{topic}: stations s must rise within 0 to {self.robot.length} m, got '
                f'{s.min():.4g} to {s.max():.4g}',
            )

    def _check_base(self, topic: str, frame: str) -> None:
        mode, wanted = self.robot.base.mode, self.robot.base.measurement.frame
        if mode != 'measured':
            raise MessageError(
                'not used', f'{topic}: the robot description says that the base is {mode}'
            )
        if frame != wanted:
            raise MessageError(
                'unknown frame',
                f"{topic}: the base is given in '{frame[:80]}'; the robot description says "
                f"'{wanted}' (base.measurement.frame)",
            )

    def _check_truth(self, topic: str, poses: int) -> None:
        expected = 1 + len(self.robot.rings)
        if poses != expected:
            raise MessageError(
                'size',
                f'{topic}: the truth holds {poses} poses; this robot has {expected}: base, '
                f'{", ".join(self.robot.ring_names)}',
            )

    def _check_stamp(self, topic: str, sample: Any, arrival: int) -> None:
        """Judge the stamp; where the data starts again there, so does the estimator."""
        gate, before = self.gate, self.gate.newest
        restarts, stamp = gate.restarts, sample.stamp
        refusal = gate.judge(stamp, getattr(sample, 'sensor', topic), arrival)
        if refusal:
            raise MessageError(
                refusal,
                f'{topic}: stamp {stamp / NANOSECONDS:.6f} s refused as {refusal} (newest '
                f'{(before or 0) / NANOSECONDS:.6f} s, clock {arrival / NANOSECONDS:.6f} s)',
            )
        if gate.restarts != restarts:
            if gate.restarts <= RESTARTS_TOLD:
                way = 'backward' if stamp < before else 'forward'
                self._report(
                    'restart',
                    f'time went {way}, from {before / NANOSECONDS:.3f} to '
                    f'{stamp / NANOSECONDS:.3f} s: the data starts again, '
                    'and so does the estimate',
                )
            self.restart()

    def _without_prefix(self, sample: Any) -> Any:
        prefix = self.frame_prefix
        if prefix and getattr(sample, 'sensor', '').startswith(prefix):
            return replace(sample, sensor=sample.sensor.removeprefix(prefix))
        return sample

    def _tell(self, kind: str, text: str) -> None:
        if kind not in self._reported:
            self._reported.add(kind)
            self._report(kind, text)


def _names(sensors: tuple) -> tuple[str, ...]:
    return tuple(sensor.name for sensor in sensors)
