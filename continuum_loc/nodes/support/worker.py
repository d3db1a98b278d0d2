"""
A node that estimates: callbacks only buffer, and one worker thread does everything else.

Reception is a single-threaded executor, so that a slow step never blocks it; what an overloaded
worker leaves behind is dropped by `Inbox` in its defined order, counted, and told on /diagnostics.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import gc
from queue import SimpleQueue
import threading
import time
from typing import Any

from continuum_loc.intake import Intake
from continuum_loc.measurements import Measurement, NANOSECONDS
from continuum_loc.nodes.support.inbox import Early, Inbox, Queued
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.quality import input_qos
from continuum_loc.nodes.support.runtime import Delays, deserialized, write_summary
from continuum_loc.robot import load_robot
from continuum_loc.settings import Settings
from msg_tools.factory import ros_messages
from msg_tools.records import DiagnosticsRecord
from msg_tools.topics import topic_spec, TRACKER
import numpy as np

OK, WARN, ERROR, STALE = range(4)
POLL = 0.1  # s; how often an idle worker looks whether it has to stop
STALE_AFTER = 2.0  # s without data
CLOCK_PATIENCE = 3.0  # s; how long a message waits for a simulated clock that is behind it
# [s] older stamps come from a bag played without its clock, and say nothing about latency.
PLAUSIBLE_LATENCY = 30.0


class WorkerNode(PackageNode):
    """
    Base of `estimator` and `shape`.

    Subclasses give `inputs`, `prepare`, `consume`, `restart` and `describe`.
    """

    inputs: tuple[str, ...] = ()

    def __init__(self, name: str, defaults: Settings, **options: Any) -> None:
        super().__init__(name, defaults, **options)
        self.robot = load_robot(self.settings.robot)
        self.inbox = Inbox(self.settings.intake)
        self.early = Early(CLOCK_PATIENCE, self.settings.intake.queue_bytes)
        self.intake = Intake(
            self.robot,
            self.settings.intake,
            self._report,
            self.settings.frame_prefix,
            restart=lambda: self.restart(),
        )
        self.latency, self.lag, self.step = Delays(), Delays(), Delays()
        self.outputs: dict[str, Any] = {}
        self._stop = threading.Event()
        self._tasks: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._received_at = 0.0
        self._told: dict[str, int] = {}

    # ------------------------------------------------ for subclasses

    def prepare(self) -> None:
        """Load and compile what the estimate needs; it may take a minute."""
        raise NotImplementedError

    def consume(self, measurement: Measurement) -> int | None:
        """
        Use one measurement and publish what follows from it.

        Returns the stamp of the estimate if there is one.
        """
        raise NotImplementedError

    def idle(self) -> bool:
        """Do a little of what can wait, as no message does; False where there is nothing to do."""
        return False

    def restart(self) -> None:
        """Forget the past: the data starts again. Called in the worker."""
        raise NotImplementedError

    def describe(self) -> tuple[int, str, dict[str, Any]]:
        """Level, message and values of the estimate itself, for /diagnostics."""
        raise NotImplementedError

    def summary(self) -> dict[str, Any]:
        """Return what the summary file holds."""
        return {
            'counts': self.counts(),
            'latency_ms': self.latency.statistics(),
            'lag_ms': self.lag.statistics(),
            'step_ms': self.step.statistics(),
            'latencies_s': list(self.latency.values),
        }

    # ------------------------------------------------ life

    def configure(self) -> None:
        """Prepare, and start the worker: while the node is inactive, nothing comes for it."""
        self.prepare()
        self.every(1.0 / self.settings.diagnostics_rate, self._publish_diagnostics)
        # What was loaded and compiled stays: to go through it again and again, as the collector
        # else does, stops the worker for 30 ms each time.
        gc.collect()
        gc.freeze()
        self._stop.clear()
        worker = self.thread(self._work, f'{self.get_name()} worker')
        worker.start()
        self.undo(self._stop_worker, worker)

    def activate(self) -> None:
        """Subscribe."""
        for topic in self._input_topics():
            spec = topic_spec(topic)
            self.listen(
                spec.type,
                topic,
                partial(self._receive, topic),
                input_qos(spec, self.settings.intake.reliable_inputs),
                raw=True,
            )
        self.get_logger().info(f"ready: robot '{self.robot.name}'")

    def close(self) -> None:
        """Write the summary."""
        write_summary(self.settings.summary_file, self.summary())

    def _stop_worker(self, worker: threading.Thread) -> None:
        self._stop.set()
        worker.join(timeout=10.0)

    def counts(self) -> dict[str, Any]:
        """
        Count what was received, used, refused and dropped before the estimator.

        Refused by class of error, dropped by topic.
        """
        return self.intake.counts() | {
            'received': dict(self.inbox.received),
            'dropped': dict(self.inbox.dropped),
        }

    def in_worker(self, task: Callable[[], None]) -> None:
        """
        Have the worker do `task` before its next message.

        Services and parameters ask from other threads.
        """
        self._tasks.put(task)

    def publish(self, topic: str, item: Any) -> None:
        """Encode and publish an item of the contract."""
        spec = topic_spec(topic)
        self.publish_message(topic, spec.encode(ros_messages(), item))

    def publish_message(self, topic: str, message: Any) -> None:
        """Publish a message on a topic of the contract; the publisher is made at its first use."""
        self.publisher(topic).publish(message)

    def publisher(self, topic: str) -> Any:
        """Return the publisher of a topic of the contract."""
        if topic not in self.outputs:
            self.outputs[topic] = super().publisher(topic)
            self.undo(self.outputs.pop, topic)
        return self.outputs[topic]

    # ------------------------------------------------ reception (executor thread)

    def _input_topics(self) -> list[str]:
        trackers = (
            [TRACKER + sensor.name for sensor in self.robot.trackers]
            if TRACKER in self.inputs
            else []
        )
        return [topic for topic in self.inputs if topic != TRACKER] + trackers

    def _receive(self, topic: str, data: bytes) -> None:
        self._received_at = time.monotonic()
        message = self.intake.parse(topic, data, self.deserialized)
        if message is None:
            self.inbox.received[topic] += 1
        else:
            self.inbox.put(topic, message, self.now(), len(data))

    def deserialized(self, data: bytes, type_name: str) -> Any:
        """Return the message of the bytes that came."""
        return deserialized(data, type_name)

    # ------------------------------------------------ estimation (worker thread)

    def _work(self) -> None:
        while not self._stop.is_set():
            leisure = not len(self.inbox) and self.intake.attempt(self.idle, 'what it had seen')
            queued = self.inbox.take(0.0 if leisure else POLL)
            while not self._tasks.empty():
                self._tasks.get()()
            for one in self._timely(queued):
                self._handle(one)

    def _timely(self, queued: Queued | None) -> list[Queued]:
        """Messages whose turn it is: `queued`, unless a simulated clock is behind it."""
        new = [] if queued is None else [queued]
        if not (self.get_clock().ros_time_is_active or len(self.early)):
            return new
        return self.early.timely(new, self.now(), self.settings.intake.future_tolerance)

    def _handle(self, queued: Queued) -> None:
        measurement = self.intake.accept(queued.topic, queued.message, queued.arrival)
        if measurement is None:
            return
        begin = time.perf_counter()
        stamp = self.intake.attempt(lambda: self.consume(measurement), queued.topic)
        if stamp is not None:
            self._note(stamp, queued, time.perf_counter() - begin)

    def _note(self, stamp: int, queued: Queued, seconds: float) -> None:
        self.step.add(seconds)
        self.lag.add(time.monotonic() - queued.received)
        latency = (self.now() - stamp) / NANOSECONDS
        if abs(latency) < PLAUSIBLE_LATENCY:
            self.latency.add(latency)

    # ------------------------------------------------ parameters, diagnostics

    def _change(self, values: dict[str, Any]) -> str | None:
        reason = super()._change(values)
        self.inbox.settings = self.intake.settings = self.intake.gate.settings = (
            self.settings.intake
        )
        return reason

    def _report(self, kind: str, text: str) -> None:
        more = '' if kind == 'restart' else f" [further cases of '{kind}' are only counted]"
        self.get_logger().warning(text + more)

    def _publish_diagnostics(self) -> None:
        level, text, values = self.describe() if self.active else (OK, 'inactive', {})
        checks = (self._check_losses, self._check_lag, self._check_silence) if self.active else ()
        for check in checks:
            level, text = max((level, text), check(), key=lambda pair: pair[0])
        values = {
            'received': sum(self.inbox.received.values()),
            'used': sum(self.intake.used.values()),
            'refused': dict(self.intake.refused),
            'dropped': dict(self.inbox.dropped),
            'queue': len(self.inbox) + len(self.early),
            **values,
        }
        shown = {
            key: f'{value:.4g}' if isinstance(value, float) else str(value)
            for key, value in values.items()
        }
        name = f'{self.get_fully_qualified_name()}: {self.robot.name}'
        self.publish('/diagnostics', DiagnosticsRecord(self.now(), ((name, level, text, shown),)))

    def _check_losses(self) -> tuple[int, str]:
        lost = {
            'dropped': sum(self.inbox.dropped.values()),
            'refused': sum(self.intake.refused.values()),
            'failures': self.intake.failures,
        }
        new = {
            key: count - self._told.get(key, 0)
            for key, count in lost.items()
            if count > self._told.get(key, 0)
        }
        self._told = lost
        return (
            (WARN, 'messages ' + ', '.join(f'{key}: {count}' for key, count in new.items()))
            if new
            else (OK, '')
        )

    def _check_lag(self) -> tuple[int, str]:
        recent = self.lag.recent(10)
        if len(recent) and float(np.median(recent)) > self.settings.lag_warning:
            return WARN, f'lagging {1e3 * float(np.median(recent)):.0f} ms behind reception'
        return OK, ''

    def _check_silence(self) -> tuple[int, str]:
        if self._received_at == 0.0:
            return WARN, 'no data yet'
        silent = time.monotonic() - self._received_at
        return (ERROR, f'no data for {silent:.1f} s') if silent > STALE_AFTER else (OK, '')
