"""Starting, spinning and stopping a node; latency bookkeeping."""

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

from continuum_loc.errors import ContinuumLocError, SettingsError
from continuum_loc.extras import explained
from continuum_loc.nodes.support.managed import HEARTBEAT, PackageNode, STEADY
from continuum_loc.nodes.support.parameters import check_arguments
from msg_tools.factory import ros_messages
import numpy as np
import rclpy
from rclpy._rclpy_pybind11 import RCLError  # rclpy gives it no public name
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.serialization import deserialize_message

BAD_INPUT = 2


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
    try:
        node = make()
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
    return 0 if failure is None else _complain(failure)


def _closed(node: PackageNode, failure: Exception | None) -> Exception | None:
    """Close a node that has failed or not; what went wrong, first."""
    if node.errand is not None:  # it is told to stop while it still compiles
        node.errand.abandon()
    try:
        node.end()
    except Exception as error:
        failure = failure or error
    node.destroy_node()
    return failure


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
    node.create_timer(HEARTBEAT, _nothing, clock=STEADY)
    node.finished.add_done_callback(lambda _: executor.create_task(_nothing))
    if not node.finished.done():
        node.begin()
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
