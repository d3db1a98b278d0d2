"""
Node `simulator`: a robot in a scene publishes every sensor in real time.

Its parameters are explained in config/simulator.yaml.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
import sys
import threading
from typing import Any

from continuum_loc.nodes.support.delivery import await_acknowledged, await_listeners
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.pacing import Paced
from continuum_loc.nodes.support.runtime import Delays, run, write_summary
from continuum_loc.nodes.support.settings import SimulatorNodeSettings
from continuum_loc.robot import load_robot
from msg_tools.factory import ros_messages
from msg_tools.records import DiagnosticsRecord
from msg_tools.topics import topic_of, topic_spec, TRACKER


class SimulatorNode(PackageNode):
    """Paces `World.run` to the wall clock and stamps with the node's clock."""

    def __init__(self, **options: Any) -> None:
        super().__init__('simulator', SimulatorNodeSettings(), **options)
        self.check_parameters()
        self.robot = load_robot(self.settings.robot)
        self.published: Counter[str] = Counter()
        self.delays = Delays()
        self.outputs: dict[str, Any] = {}
        self._state = 'preparing'
        self._failure: BaseException | None = None
        self._shift: int | None = None

    def configure(self) -> None:
        """Make the world and its outputs."""
        self.world = self._world()
        self.outputs = {topic: self.publisher(topic) for topic in self._topics()}
        self._diagnostics = self.publisher('/diagnostics')
        self.every(1.0 / self.settings.diagnostics_rate, self._publish_diagnostics)

    def activate(self) -> None:
        """Begin the trajectory, from its start."""
        self._state = 'preparing'
        self._paced = Paced(self._stamped(), self.settings.lookahead)
        simulation = threading.Thread(target=self._simulate, name='simulation', daemon=True)
        simulation.start()
        self.undo(self._stop_simulation, simulation)

    def _stop_simulation(self, simulation: threading.Thread) -> None:
        self._paced.stop()
        self._state = self._state if self._state == 'finished' else 'stopped'
        simulation.join(timeout=10.0)

    def close(self) -> None:
        """Write the summary; raise what ended the simulation, if anything did."""
        write_summary(
            self.settings.summary_file,
            {
                'published': dict(self.published),
                'state': self._state,
                'delay_ms': self.delays.statistics(),
            },
        )
        if self._failure is not None:
            raise self._failure

    def _world(self) -> Any:
        from continuum_loc.offline.trials import Trial, world

        s = self.settings
        trial = Trial(
            s.robot,
            s.scene,
            s.trajectory,
            profile=s.profile,
            fidelity=s.tof_fidelity,
            seed=s.seed,
            plant=s.plant or None,
            world=s.world,
        )
        return world(trial)

    def _topics(self) -> list[str]:
        kinds = {
            'tof/points': self.robot.tof,
            'imu/data_raw': self.robot.imu,
            'imu/mag': self.robot.hall,
            'strain': self.robot.strain,
            'joint_states': True,
            'base/pose': self.robot.base.mode == 'measured',
            'ground_truth/poses': True,
        }
        return [topic for topic, present in kinds.items() if present] + [
            TRACKER + t.name for t in self.robot.trackers
        ]

    # ------------------------------------------------ simulation (its own threads)

    def _stamped(self) -> Iterator[tuple[int, Any]]:
        duration = self.settings.duration or None
        return ((sample.stamp, sample) for sample in self.world.run(duration))

    def _simulate(self) -> None:
        try:
            if self._wait_for_listeners():
                self._state = 'running'
                self._paced.run(self._deliver, self._begin)
                await_acknowledged(self.outputs.values())
                self._state = 'finished'
        except BaseException as error:
            if self.context.ok():
                self._failure = error
        if self._state != 'stopped':
            self.finish()

    def _wait_for_listeners(self) -> bool:
        return await_listeners(
            self.outputs.values(),
            self.outputs['tof/points' if self.robot.tof else 'imu/data_raw'],
            self.settings.wait_for,
            self.settings.wait_timeout,
            lambda: self._state == 'stopped',
        )

    def _begin(self, first: int) -> None:
        """
        Let the first sample be due one lookahead from now.

        From there, data time is the node's clock.
        """
        self._shift = self.now() + round(self.settings.lookahead * 1e9) - first
        self.get_logger().info('data begins')

    def _deliver(self, stamp: int, sample: Any, delay: float) -> None:
        topic = topic_of(sample)
        if topic == 'ground_truth/poses' and not self.settings.publish_truth:
            return
        sample = replace(sample, stamp=stamp + self._shift)
        if self.settings.frame_prefix and hasattr(sample, 'sensor'):
            sample = replace(sample, sensor=self.settings.frame_prefix + sample.sensor)
        self.outputs[topic].publish(topic_spec(topic).encode(ros_messages(), sample))
        self.published[topic] += 1
        self.delays.add(delay)

    # ------------------------------------------------ diagnostics

    def _publish_diagnostics(self) -> None:
        recent = self.delays.recent(500)
        worst = float(recent.max()) if len(recent) else 0.0
        behind = self._state == 'running' and worst > self.settings.behind_warning
        text = f'{1e3 * worst:.0f} ms behind the clock' if behind else self._state
        values = {
            'published': str(sum(self.published.values())),
            'worst recent delay [ms]': f'{1e3 * worst:.1f}',
        }
        name = f'{self.get_fully_qualified_name()}: {self.robot.name}'
        record = DiagnosticsRecord(self.now(), ((name, 1 if behind else 0, text, values),))
        self._diagnostics.publish(topic_spec('/diagnostics').encode(ros_messages(), record))


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(SimulatorNode, args))


if __name__ == '__main__':
    main()
