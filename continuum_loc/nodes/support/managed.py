"""
A managed node (REP-2002's states, by rclpy.lifecycle) that goes all the way by itself.

What a node needs is made by `configure`, which may compile for a minute; it works from `activate`
on. Each notes how it is undone, and cleaning up or deactivating does that, the last first.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
import os
import sys
import threading
from typing import Any
from weakref import WeakSet

from continuum_loc.errors import ContinuumLocError
from continuum_loc.nodes.support.parameters import (
    declare,
    guard,
    is_set_to,
    read,
    refuse_unknown,
)
from continuum_loc.nodes.support.quality import output_qos
from continuum_loc.nodes.support.settings import NodeSettings
from msg_tools.factory import ros_messages
from msg_tools.topics import topic_spec
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy._rclpy_pybind11 import RCLError  # rclpy gives it no public name
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future

HEARTBEAT = 0.2  # s
GRACE = 0.2  # s; in which an errand may end by itself when the node is told to stop
STEADY = Clock(clock_type=ClockType.STEADY_TIME)
SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)

_nodes: WeakSet[PackageNode] = WeakSet()  # of this process


class PackageNode(LifecycleNode):
    """
    A managed node with typed settings that can end by itself: `finish` ends its spin.

    Subclasses give `configure` and `activate`. What these make by `listen`, `publisher`, `serve`
    and `every`, or hand to `undo`, goes again with `deactivate` and `cleanup`.
    """

    def __init__(self, name: str, defaults: NodeSettings, **options: Any) -> None:
        super().__init__(name, **options)
        _nodes.add(self)
        self.finished = Future()
        self.failure: Exception | None = None
        self.settings = declare(self, defaults)
        self.active = False
        self._undo_activation, self._undo_configuration = ExitStack(), ExitStack()
        self._stack = self._undo_configuration
        self._errand: Errand | None = None
        self._guarded = False
        _refuse_impossible_transitions(self)

    # ------------------------------------------------ for subclasses

    def configure(self) -> None:
        """Load and compile what the node needs; nothing is said or heard yet."""

    def activate(self) -> None:
        """Begin to work."""

    def close(self) -> None:
        """Write files. Called once, after the last callback, when all is undone."""

    # ------------------------------------------------ life

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `configure` in a thread of its own, so that a signal ends it at any point."""
        self._stack = self._undo_configuration
        return self._outcome(lambda: self._run_errand(self.configure), self._undo_configuration)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run `activate`."""
        super().on_activate(state)  # from here on publishers publish
        self.active, self._stack = True, self._undo_activation
        outcome = self._outcome(self.activate, self._undo_activation)
        if outcome is not SUCCESS:
            super().on_deactivate(state)
            self.active = False
        return outcome

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo what `activate` did."""
        outcome = self._outcome(self._undo_activation.close)
        self.active = False
        super().on_deactivate(state)
        return outcome

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo what `configure` did."""
        return self._outcome(self._undo_configuration.close)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the node, and with it its process."""
        self.finish()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo everything: the node is unconfigured again."""
        self.active = False
        self._undo_activation.close()
        self._undo_configuration.close()
        return SUCCESS

    def begin(self) -> None:
        """
        Configure and activate, unless parameter `autostart` says that somebody else does.

        Returns at once. What goes wrong ends the node.
        """
        if self.settings.autostart:
            self.thread(self._start_by_itself, 'autostart').start()
        else:
            self.get_logger().info('waiting to be configured (autostart is false)')

    def end(self) -> None:
        """Undo everything and close; after the last callback."""
        try:
            self.on_error(None)
        finally:
            self.close()

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

    @property
    def errand(self) -> Errand | None:
        """What still runs of `configure` in a thread that nothing but the process's end stops."""
        return None if self._errand is None or self._errand.done else self._errand

    def _start_by_itself(self) -> None:
        self.trigger_configure()
        if self.failure is None and self.context.ok():
            self.executor.create_task(self.trigger_activate)

    def _run_errand(self, work: Callable[[], None]) -> None:
        self._errand = Errand(work)
        self._errand.wait(self.context.ok)

    def _outcome(
        self, work: Callable[[], None], undo: ExitStack | None = None
    ) -> TransitionCallbackReturn:
        """Do a transition's work; where it fails, undo what it did, and end or say so."""
        try:
            work()
        except ExternalShutdownException:
            return ERROR
        except Exception as error:
            if undo is not None:
                undo.close()
            return self._failed(error)
        return SUCCESS

    def _failed(self, error: Exception) -> TransitionCallbackReturn:
        """End a node that started by itself; a managed one says why, and can be told again."""
        if self.settings.autostart:
            self.fail(error)
        elif isinstance(error, ContinuumLocError):
            self.get_logger().error(str(error))
        else:
            self.get_logger().error(f'{type(error).__name__}: {error}')
        return FAILURE

    # ------------------------------------------------ what is undone by itself

    def undo(self, action: Callable[..., Any], *arguments: Any) -> None:
        """Have an action done when what is being configured or activated is undone."""
        self._stack.callback(action, *arguments)

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
            ros_messages().resolve(type_name), topic, take, qos, raw=raw, **_overridable()
        )
        self.undo(self.destroy_subscription, subscription)

    def publisher(self, topic: str) -> Any:
        """Make a publisher of a topic of the contract; all but /diagnostics are managed."""
        spec = topic_spec(topic)
        kind, qos = ros_messages().resolve(spec.type), output_qos(spec)
        if topic != '/diagnostics':
            return self.managed_publisher(kind, topic, qos)
        made = self.create_publisher(kind, topic, qos, **_overridable())
        self.undo(self.destroy_publisher, made)
        return made

    def managed_publisher(self, kind: type, topic: str, qos: QoSProfile) -> Any:
        """Make a publisher that is mute while the node is inactive."""
        made = self.create_lifecycle_publisher(kind, topic, qos, **_overridable())
        if self.active:
            made.on_activate(None)
        self.undo(self.destroy_lifecycle_publisher, made)
        return made

    def serve(self, kind: type, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service."""
        self.undo(self.destroy_service, self.create_service(kind, name, answer))

    def every(self, period: float, action: Callable[[], None]) -> None:
        """Do `action` each `period` seconds of real time: a simulated clock may stand still."""
        self.undo(self.destroy_timer, self.create_timer(period, action, clock=STEADY))

    def now(self) -> int:
        """Read the node's clock in integer nanoseconds (0 while simulated time has not begun)."""
        return self.get_clock().now().nanoseconds

    # ------------------------------------------------ parameters

    def _apply_descriptor(
        self,
        parameter: Parameter,
        descriptor: ParameterDescriptor | None = None,
        check_read_only: bool = True,
    ) -> SetParametersResult:
        """Let a read-only parameter be set to what it is, as a dump of the node's own does."""
        changes = check_read_only and not is_set_to(self, parameter)
        return super()._apply_descriptor(parameter, descriptor, changes)

    def check_parameters(self) -> None:
        """Refuse strange parameters, and changes that cannot be; call it when all are declared."""
        refuse_unknown(self)
        if not self._guarded:
            guard(self, self._change)
            self._guarded = True

    def _change(self, values: dict[str, Any]) -> str | None:
        """Take changed parameters (none is read-only), or return the reason why not."""
        self.settings = read(self, type(self.settings), changed=values)
        return None


class Errand:
    """
    Work in a thread of its own, while this one hears signals.

    The first node on a machine compiles for a minute, most of it inside LLVM, and rclpy's handler
    of signals only says that ROS is shut down, which nobody would look at meanwhile.
    """

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._error: BaseException | None = None
        # Not the thread itself: one whose `join` a signal interrupted counts as ended.
        self._done = threading.Event()
        threading.Thread(target=self._run, name='errand', daemon=True).start()

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._done.is_set()

    def wait(self, going: Callable[[], bool]) -> None:
        """
        Wait for the end.

        Raises what the work raised, or ExternalShutdownException when `going` no more.
        """
        while not self._done.wait(HEARTBEAT):
            if not going():
                raise ExternalShutdownException
        if self._error is not None:
            raise self._error

    def abandon(self) -> None:
        """End the process unless the work ends at once: nothing else ends a compilation."""
        sys.setswitchinterval(1e-4)  # the other thread computes, and this one is in a hurry
        if self._done.wait(GRACE):
            return
        for node in list(_nodes):  # so that nothing of theirs is left on the graph
            node.destroy_node()
            node.context.destroy()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as error:
            self._error = error
        finally:
            self._done.set()


def _overridable() -> dict[str, QoSOverridingOptions]:
    """Let `qos_overrides.<topic>.<publisher or subscription>.depth` and the like be parameters."""
    return {'qos_overriding_options': QoSOverridingOptions.with_default_policies()}


def _refuse_impossible_transitions(node: LifecycleNode) -> None:
    """Answer no where there is no such transition: rclpy lets its error end the whole node."""
    service = node._service_change_state
    answer = service.callback

    def guarded(request: Any, response: Any) -> Any:
        try:
            return answer(request, response)
        except RCLError:
            state = node._state_machine.current_state[1]
            wanted = request.transition.label or request.transition.id
            node.get_logger().warning(f"no transition '{wanted}' from state {state}")
            response.success = False
            return response

    service.callback = guarded
