"""
What the node tests share.

Nodes as processes on a graph of their own, and a client that talks to them.
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from continuum_loc.measurements import (
    EncoderSample,
    ImuSample,
    nanoseconds,
    StrainSample,
    TofFrame,
)
from continuum_loc.nodes.support.quality import output_qos
from continuum_loc.offline.domain import Domain
from continuum_loc.robot import load_robot
from msg_tools.factory import ros_messages
from msg_tools.topics import topic_spec
import numpy as np
from rcl_interfaces.srv import GetParameters
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 60.0  # s; generous: discovery alone may take seconds, and the machine may be busy
ANSWER = 5.0  # s; a service that has not answered by then is asked again
COMPILING = 240.0  # s; where nothing has been compiled before, and the machine is busy

ROBOT = """
name: stub
length: 0.3
radius: 0.01
rings: [{name: ring1, s: 0.15}, {name: ring2, s: 0.3}]
tof_model: {rate: 15.0}
imu_model: {rate: 50.0}
strain: {spacing: 0.05}
tof:
  - {name: up, ring: ring2, mount: {azimuth_deg: 90, radius: 0.012}}
  - {name: down, ring: ring1, mount: {azimuth_deg: -90, radius: 0.012}}
  - {name: tip, ring: ring2, mount: {xyz: [0.005, 0, 0], rpy_deg: [0, 0, 0]}}
imu: [{name: imu1, ring: ring1}, {name: imu2, ring: ring2}]
"""
BOX = np.array([[-0.2, -0.3, -0.3], [0.6, 0.3, 0.3]])


_domains: dict[int, Domain] = {}
_running: list[Process] = []


def fresh_domain() -> int:
    """Return a ROS_DOMAIN_ID that no other graph has; it is kept until `clean_up`."""
    domain = Domain()
    _domains[domain.number] = domain
    return domain.number


def clean_up() -> None:
    """End what a failed test left running, and give the domains back."""
    for process in _running:
        if process.popen.poll() is None:
            process.popen.kill()
            process.popen.wait()
    _running.clear()
    for domain in _domains.values():
        domain.close()
    _domains.clear()


def wait_until(condition, patience: float = PATIENCE, step=lambda: time.sleep(0.02)) -> bool:
    """Whether `condition()` comes true; `step()` is called meanwhile."""
    deadline = time.monotonic() + patience
    while not condition():
        if time.monotonic() > deadline:
            return False
        step()
    return True


class Process:
    """A node of the package as a process; `log` is what it wrote."""

    def __init__(
        self, node: str, domain: int, folder: Path, *arguments: str, **parameters
    ) -> None:
        self.path = folder / f'{node}_{time.monotonic_ns()}.log'
        given = [part for name, value in parameters.items() for part in ('-p', f'{name}:={value}')]
        environment = os.environ | {
            'ROS_DOMAIN_ID': str(domain),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'OMP_NUM_THREADS': '1',
            'PYTHONUNBUFFERED': '1',
            'PYTHONFAULTHANDLER': '1',
        }
        with self.path.open('w') as log:
            self.popen = subprocess.Popen(
                [
                    sys.executable,
                    '-m',
                    f'continuum_loc.nodes.{node}',
                    '--ros-args',
                    *arguments,
                    *given,
                ],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env=environment,
                # A node that outlives its test still holds the domain, and disturbs nobody.
                pass_fds=(_domains[domain].lock,),
            )
        _running.append(self)

    @property
    def log(self) -> str:
        return self.path.read_text(errors='replace')

    def await_log(self, text: str, patience: float = PATIENCE) -> None:
        assert (
            wait_until(lambda: text in self.log or self.popen.poll() is not None, patience)
            and text in self.log
        ), self.log

    def stop(self, how: int = signal.SIGINT) -> int:
        """Signal the node and wait; its exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(how)
        return self.wait()

    def wait(self) -> int:
        """Wait for the node's end; its exit code. One that hangs says where."""
        if not wait_until(lambda: self.popen.poll() is not None):
            self.popen.send_signal(signal.SIGABRT)
            self.popen.wait()
            raise AssertionError(f'the node did not end:\n{self.log}')
        return self.popen.returncode


class Client:
    """A node of the test's own: publishes and hears on one domain."""

    def __init__(self, domain: int, namespace: str = '') -> None:
        os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = Node(
            'client', context=self.context, namespace=namespace, start_parameter_services=False
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard: dict[str, list] = {}
        self._publishers: dict[str, object] = {}

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def spin(self, seconds: float = 0.02) -> None:
        self.executor.spin_once(timeout_sec=seconds)

    def until(self, condition, patience: float = PATIENCE) -> bool:
        return wait_until(condition, patience, self.spin)

    def hear(self, topic: str, qos=None) -> list:
        """Yield the decoded items that come on a topic of the contract, as they come."""
        spec = topic_spec(topic)
        items = self.heard.setdefault(topic, [])
        self.node.create_subscription(
            ros_messages().resolve(spec.type),
            topic,
            lambda message: items.append(spec.decode(message, 1, topic)),
            qos or output_qos(spec),
        )
        return items

    def publisher(self, topic: str, qos=None):
        if topic not in self._publishers:
            spec = topic_spec(topic)
            self._publishers[topic] = self.node.create_publisher(
                ros_messages().resolve(spec.type), topic, qos or output_qos(spec)
            )
        return self._publishers[topic]

    def send(self, topic: str, item) -> None:
        self.publisher(topic).publish(topic_spec(topic).encode(ros_messages(), item))

    def await_listeners(self, *topics: str, count: int = 1) -> None:
        """Wait until `count` subscriptions hear these topics, and know that we say them."""
        assert self.until(
            lambda: all(self.publisher(t).get_subscription_count() >= count for t in topics)
        ), f'nobody listens to {topics}'
        self._await_acquaintance(topics, self.node.get_subscriptions_info_by_topic)

    def await_speakers(self) -> None:
        """
        Wait until somebody publishes on every topic that this client hears, and knows of it.

        A message that is sent before that is lost.
        """
        assert self.until(
            lambda: all(self.node.count_publishers(topic) > 0 for topic in self.heard)
        ), f'nobody publishes one of {list(self.heard)}'
        self._await_acquaintance(self.heard, self.node.get_publishers_info_by_topic)

    def _await_acquaintance(self, topics, endpoints) -> None:
        """
        Wait until the nodes at the other ends of these topics know of our ends.

        DDS announces a participant's endpoints in the order of their making: a node that answers
        a client made just now knows all that was made before. That this side has matched says
        nothing about the other, which on a busy machine may follow seconds later.
        """

        def others() -> set[str]:
            ends = [end for topic in topics for end in endpoints(self._full(topic))]
            return {f'{end.node_namespace.rstrip("/")}/{end.node_name}' for end in ends}

        def named() -> bool:  # the names come by a topic of their own
            return not any('_UNKNOWN_' in name for name in others())

        assert self.until(named), others()
        for name in others():
            if not name.endswith('/client'):  # another client of the test has no services
                self.call(GetParameters, f'{name}/get_parameters', GetParameters.Request())

    def _full(self, topic: str) -> str:
        return self.node.resolve_topic_name(topic)

    def call(self, kind, name: str, request):
        """
        Ask a service until it answers.

        rmw_fastrtps drops an answer where the server has not matched the client within 0.1 s.
        """
        client = self.node.create_client(kind, name)
        try:
            assert self.until(client.service_is_ready), f'no service {name}'
            for _ in range(round(PATIENCE / ANSWER)):
                future = client.call_async(request)
                if self.until(future.done, ANSWER):
                    return future.result()
            raise AssertionError(f'service {name} does not answer')
        finally:
            self.node.destroy_client(client)

    def now(self) -> int:
        return self.node.get_clock().now().nanoseconds


class BoxRobot:
    """
    Samples of a straight, resting robot in a box.

    The distances are known, and so the right estimate.
    """

    def __init__(self, folder: Path) -> None:
        self.path, self.map = folder / 'stub.yaml', folder / 'box.csv'
        self.path.write_text(ROBOT)
        self.robot = load_robot(self.path)
        self._write_map()
        # A sensor that repeats itself to the last bit counts as frozen.
        self._rng = np.random.default_rng(0)
        self.T_map_ring = np.tile(np.eye(4), (3, 1, 1))
        self.T_map_ring[1:, 0, 3] = self.robot.ring_arclengths

    def samples(self, stamp: int):
        """(topic, sample) of every sensor at one instant."""
        for sensor in self.robot.tof:
            yield 'tof/points', self.frame(sensor, stamp)
        for sensor in self.robot.imu:
            yield (
                'imu/data_raw',
                ImuSample(
                    stamp, sensor.name, 1e-3 * self._rng.normal(size=3), np.array([0, 0, 9.81])
                ),
            )
        s = self.robot.strain_stations
        yield 'strain', StrainSample(stamp, s, 0 * s, 0 * s)
        yield 'joint_states', EncoderSample(stamp, ('insertion',), np.zeros(1), np.zeros(1))

    def frame(self, sensor, stamp: int) -> TofFrame:
        """Measure the distances to the box, to half a millimetre."""
        ring = 1 + self.robot.ring_names.index(sensor.ring)
        T = self.T_map_ring[ring] @ sensor.mount.T_ring_sensor
        rays = self.robot.tof_model.directions
        directions = rays @ T[:3, :3].T
        with np.errstate(divide='ignore', invalid='ignore'):
            walls = np.where(
                directions > 0.0,
                (BOX[1] - T[:3, 3]) / directions,
                (BOX[0] - T[:3, 3]) / directions,
            )
        ranges = np.nanmin(np.where(directions == 0.0, np.inf, walls), axis=1)
        ranges = ranges + 5e-4 * self._rng.normal(size=len(ranges))
        return TofFrame(
            stamp,
            sensor.name,
            ranges[:, None] * rays,
            ranges,
            self.robot.tof_model.sigma(ranges),
            np.full(len(rays), 5, np.uint8),
        )

    def play(
        self, client: Client, seconds: float, start: int | None = None, rate: float = 15.0
    ) -> list[int]:
        """Publish in real time; the stamps."""
        begin, origin = time.monotonic(), client.now() if start is None else start
        stamps = [origin + nanoseconds(tick / rate) for tick in range(round(seconds * rate))]
        for tick, stamp in enumerate(stamps):
            for topic, sample in self.samples(stamp):
                client.send(topic, sample)
            while time.monotonic() < begin + (tick + 1) / rate:
                client.spin(0.005)
        return stamps

    def _write_map(self) -> None:
        lines = ['x,y,z,nx,ny,nz,planarity']
        for axis in range(3):
            others = [a for a in range(3) if a != axis]
            grid = np.stack(
                np.meshgrid(*(np.arange(BOX[0, a], BOX[1, a] + 1e-9, 0.01) for a in others)), -1
            )
            for side in range(2):
                points = np.empty((grid[..., 0].size, 3))
                points[:, others], points[:, axis] = grid.reshape(-1, 2), BOX[side, axis]
                normal = [0, 0, 0]
                normal[axis] = 1 - 2 * side  # into the box: where the robot is
                lines += [
                    f'{x:.4f},{y:.4f},{z:.4f},{normal[0]},{normal[1]},{normal[2]},1'
                    for x, y, z in points
                ]
        self.map.write_text('\n'.join(lines) + '\n')
