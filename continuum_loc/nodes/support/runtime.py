"""Starting, spinning and stopping a node; quality of service; latency bookkeeping."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import islice
import json
import os
from pathlib import Path
import signal
import sys
import tempfile
import threading
from typing import Any
from weakref import WeakSet

from continuum_loc.errors import ContinuumLocError, SettingsError
from continuum_loc.extras import explained
from continuum_loc.nodes.support.parameters import (
    check_arguments,
    declare,
    guard,
    live_fields,
    read,
    refuse_unknown,
)
from continuum_loc.settings import Settings
from msg_tools.factory import ros_messages
from msg_tools.topics import Topic, topic_spec
import numpy as np
import rclpy
from rclpy._rclpy_pybind11 import RCLError  # rclpy gives it no public name
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.task import Future

BAD_INPUT = 2
HEARTBEAT = 0.2  # s
GRACE = 0.2  # s; in which a node that is being made may end by itself when it is told to stop
STEADY = Clock(clock_type=ClockType.STEADY_TIME)

_nodes: WeakSet[PackageNode] = WeakSet()  # of this process, also those that are still being made


class PackageNode(Node):
    """A node with typed settings that can end by itself: `finish` ends its spin."""

    def __init__(self, name: str, defaults: Settings, **options: Any) -> None:
        super().__init__(name, **options)
        _nodes.add(self)
        self.finished = Future()
        self.failure: Exception | None = None
        self.settings = declare(self, defaults)
        self._guarded = False

    def finish(self) -> None:
        """End the spin of this node (from any thread)."""
        if not self.finished.done():
            self.finished.set_result(None)

    def fail(self, error: Exception) -> None:
        """End the node with an error (from any thread); the first one counts."""
        self.failure = self.failure or error
        self.finish()

    def thread(self, work: Callable[[], None], name: str) -> threading.Thread:
        """
        Make a thread whose failure is the node's, which ends then with an error.

        A node that lives on without one of its threads is deaf or mute, and nobody knows.
        """

        def guarded() -> None:
            try:
                work()
            except Exception as error:
                if self.context.ok():  # else it is the end that surfaces, as any of rclpy's errors
                    self.fail(error)

        return threading.Thread(target=guarded, name=name, daemon=True)

    def close(self) -> None:
        """Stop threads, write files. Called once, after the last callback."""

    def listen(
        self,
        type_name: str,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        raw: bool = False,
    ) -> None:
        """
        Subscribe, taking all that waits at each wake-up.

        An executor takes one message of each topic in turn, so that in a backlog the busy topics
        fall behind the quiet ones; and it builds a wait set for each.
        """

        def take(message: Any) -> None:
            while message is not None:
                callback(message)
                with subscription.handle:
                    taken = subscription.handle.take_message(
                        subscription.msg_type, subscription.raw
                    )
                message = None if taken is None else taken[0]

        subscription = self.create_subscription(
            ros_messages().resolve(type_name), topic, take, qos, raw=raw
        )

    def publisher(self, topic: str) -> Any:
        """Make a publisher of a topic of the contract."""
        spec = topic_spec(topic)
        return self.create_publisher(ros_messages().resolve(spec.type), topic, output_qos(spec))

    def every(self, period: float, action: Callable[[], None]) -> None:
        """Do `action` each `period` seconds of real time: a simulated clock may stand still."""
        self.create_timer(period, action, clock=STEADY)

    def now(self) -> int:
        """Read the node's clock in integer nanoseconds (0 while simulated time has not begun)."""
        return self.get_clock().now().nanoseconds

    def check_parameters(self) -> None:
        """Refuse strange parameters, and changes that cannot be; call it when all are declared."""
        refuse_unknown(self)
        if not self._guarded:
            guard(self, self._change)
            self._guarded = True

    def live_parameters(self) -> set[str]:
        """Return the names of the parameters that may change while the node runs."""
        return live_fields(type(self.settings))

    def _change(self, values: dict[str, Any]) -> str | None:
        """Take changed parameters, or return the reason why not."""
        fixed = sorted(set(values) - self.live_parameters())
        if fixed:
            return f"'{fixed[0]}' is fixed while the node runs: set it when you start it"
        self.settings = read(self, type(self.settings), changed=values)
        return None


def run(make: Callable[[], PackageNode], args: list[str] | None = None) -> int:
    """
    Make a node, spin it until it finishes or is told to stop, and return the exit code.

    The code is 0, or 2 where something that was given cannot be used.
    """
    _provide_log_folder()
    try:
        check_arguments(sys.argv if args is None else args)
        rclpy.init(args=args)
    except (RCLError, SettingsError) as error:  # arguments that cannot be understood
        print(f'error: {error}', file=sys.stderr)
        return BAD_INPUT
    node, failure = None, None
    making = _Making(make)
    try:
        node = making.result()
        _spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception as error:
        # A signal may surface as any of rclpy's errors, from a publish in flight for instance.
        failure = error if rclpy.ok() else None
    finally:
        _ignore_signals()
        if node is not None:
            failure = _closed(node, failure or node.failure)
        rclpy.try_shutdown()
        making.abandon()
    return 0 if failure is None else _complain(failure)


def _closed(node: PackageNode, failure: Exception | None) -> Exception | None:
    """Close a node that has failed or not; what went wrong, first."""
    try:
        node.close()
    except Exception as error:
        failure = failure or error
    node.destroy_node()
    return failure


class _Making:
    """
    The making of a node in a thread of its own, while this one hears signals.

    The first one on a machine compiles for a minute or two, most of it inside LLVM, and rclpy's
    handler of signals only says that ROS is shut down, which nobody would look at meanwhile.
    """

    def __init__(self, make: Callable[[], PackageNode]) -> None:
        self._make = make
        self._node: PackageNode | None = None
        self._error: BaseException | None = None
        # Not the thread itself: one whose `join` a signal interrupted counts as ended.
        self._done = threading.Event()
        threading.Thread(target=self._work, name='making', daemon=True).start()

    def result(self) -> PackageNode:
        """
        Wait for the node.

        Raises what its making raised, or ExternalShutdownException when told to stop before.
        """
        while not self._done.wait(HEARTBEAT):
            if not rclpy.ok():
                raise ExternalShutdownException
        if self._error is not None:
            raise self._error
        return self._node

    def abandon(self) -> None:
        """End the process where the node is still being made: nothing else ends a compilation."""
        sys.setswitchinterval(1e-4)  # the other thread computes, and this one is in a hurry
        if self._done.wait(GRACE):
            return
        for node in _nodes:  # so that nothing of theirs is left on the graph
            node.destroy_node()
        rclpy.get_default_context().destroy()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)

    def _work(self) -> None:
        try:
            self._node = self._make()
        except BaseException as error:
            self._error = error
        finally:
            self._done.set()


def _spin(node: PackageNode) -> None:
    """
    Spin until the node finishes or is told to stop.

    Not by `spin_until_future_complete`, which hangs one more callback on the future at each turn:
    4 MiB a minute at the engine robot's rates, all of which the garbage collector goes through.
    A turn waits for something to do. rclpy's handler of signals wakes it before it says that ROS
    is shut down, so that one without anything to do may miss that; hence a heartbeat.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    node.every(HEARTBEAT, _nothing)
    node.finished.add_done_callback(lambda _: executor.create_task(_nothing))
    try:
        while node.context.ok() and not node.finished.done():
            executor.spin_once()
    finally:
        executor.remove_node(node)


def _nothing() -> None:
    """Wake an executor, and that is all."""


def _ignore_signals() -> None:
    """Let nothing interrupt the end: a terminal and a launch file may both send their SIGINT."""
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)


def _complain(error: Exception) -> int:
    """One clear line for what the user can mend; the traceback for what only we can."""
    if isinstance(error, ModuleNotFoundError):
        error = explained(error)
    if isinstance(error, ContinuumLocError):
        print(f'error: {error}', file=sys.stderr)
        return BAD_INPUT
    raise error


def _provide_log_folder() -> None:
    """rclpy.init fails where it finds no place for logs, as in a container without HOME."""
    if not any(os.environ.get(name) for name in ('HOME', 'ROS_HOME', 'ROS_LOG_DIR')):
        os.environ['ROS_LOG_DIR'] = tempfile.gettempdir()


def deserialized(data: bytes, type_name: str) -> Any:
    """Return the rclpy message of a type such as `sensor_msgs/msg/Imu` that was taken raw."""
    return deserialize_message(data, ros_messages().resolve(type_name))


def input_qos(topic: Topic, reliable: bool) -> QoSProfile:
    """
    Quality of service of an input: best effort hears every publisher.

    The depth of its queue bridges a slow moment of the node.
    """
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=topic.depth, reliability=reliability)


def output_qos(topic: Topic) -> QoSProfile:
    """Reliable, which every subscription accepts; latched where the contract says so."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


def write_summary(path: str, data: dict[str, Any]) -> None:
    """Write a node's summary as JSON, whole or not at all; nothing where `path` is empty."""
    if not path:
        return
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_suffix('.partial')
    partial.write_text(json.dumps(data, indent=1))
    partial.replace(target)


class Delays:
    """Delays in seconds: the newest 100,000 of them, so that memory stays bounded."""

    def __init__(self) -> None:
        self.values: deque[float] = deque(maxlen=100_000)

    def add(self, seconds: float) -> None:
        """Note one delay."""
        self.values.append(seconds)

    def statistics(self) -> dict[str, float]:
        """Count, mean, p50, p95, p99 and maximum in milliseconds; empty when there was none."""
        if not self.values:
            return {}
        ms = 1e3 * np.array(self.values)
        p50, p95, p99 = np.percentile(ms, (50, 95, 99))
        return {
            'count': len(ms),
            'mean': float(ms.mean()),
            'p50': float(p50),
            'p95': float(p95),
            'p99': float(p99),
            'max': float(ms.max()),
        }

    def recent(self, count: int) -> np.ndarray:
        """(<= count,) the newest delays [s], without a look at all the others."""
        return np.array(list(islice(reversed(self.values), count))[::-1])
