"""
Node `replayer`: a bag's sensors and truth back onto the graph.

With /clock, as `ros2 bag play --clock` does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
import sys
import threading
from typing import Any

from continuum_loc.errors import BagError, SettingsError
from continuum_loc.measurements import nanoseconds
from continuum_loc.nodes.support.delivery import await_acknowledged, await_listeners
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.pacing import Paced
from continuum_loc.nodes.support.runtime import run
from continuum_loc.nodes.support.settings import ReplayerNodeSettings
from msg_tools.bag import contract_topics, open_bag, raw_messages
from msg_tools.factory import ros_messages
from msg_tools.geometry import time_message
from msg_tools.topics import INPUTS, TOPICS, TRACKER
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

LOOKAHEAD = 0.5  # s
LONGEST_PAUSE = 10.0  # s of the log; a longer one, as another clock makes it, is skipped
CLOCK = '/clock'


class ReplayerNode(PackageNode):
    """Publishes serialised messages as they are in the bag, at the pace of the log."""

    def __init__(self, **options: Any) -> None:
        super().__init__('replayer', ReplayerNodeSettings(), **options)
        self.check_parameters()
        self.path = Path(self.settings.bag)
        self.published: Counter[str] = Counter()
        self.outputs: dict[str, Any] = {}
        self._clock_output: Any = None
        self._paced: Paced | None = None
        self._stop = threading.Event()

    def configure(self) -> None:
        """Look what is in the bag."""
        self.outputs = {topic: self.publisher(topic) for topic in self._topics()}
        if self.settings.clock:
            self._clock_output = self.managed_publisher(Clock, CLOCK, QoSProfile(depth=10))

    def activate(self) -> None:
        """Play it from its start."""
        self._stop.clear()
        player = self.thread(self._play, 'player')
        player.start()
        self.undo(self._stop_playing, player)

    def _stop_playing(self, player: threading.Thread) -> None:
        self._stop.set()
        if self._paced is not None:
            self._paced.stop()
        player.join(timeout=10.0)

    def _topics(self) -> list[str]:
        with open_bag(self.path) as reader:
            names = contract_topics(
                self.path, reader.connections, self.settings.namespace_in_bag or None
            )
        present = set(names.values())
        chosen = self.settings.topics
        if chosen == ('inputs',):
            chosen = (*INPUTS, TRACKER, 'ground_truth/poses')
        unknown = [topic for topic in chosen if topic not in TOPICS]
        if unknown:
            raise SettingsError(
                f"parameter 'topics': no topic '{unknown[0]}'; valid: inputs, {', '.join(TOPICS)}"
            )
        topics = [
            topic
            for topic in present
            if topic in chosen or (TRACKER in chosen and topic.startswith(TRACKER))
        ]
        if not topics:
            raise BagError(
                f'{self.path}: none of {", ".join(chosen)} is in it; '
                f'it holds {", ".join(sorted(present))}'
            )
        return sorted(topics)

    def _play(self) -> None:
        going = self._wait_for_listeners()
        while going and not self._stop.is_set():
            self._paced = Paced(self._entries(), LOOKAHEAD, self.settings.rate, LONGEST_PAUSE)
            self._paced.run(self._deliver)
            going = self.settings.loop
        if not self._stop.is_set():
            await_acknowledged(self.outputs.values())
            self.finish()

    def _wait_for_listeners(self) -> bool:
        """Begin when enough subscriptions listen to the bag's busiest kind of sensor."""
        some = next(iter(self.outputs.values()))
        first = next((self.outputs[topic] for topic in INPUTS if topic in self.outputs), some)
        return await_listeners(
            self.outputs.values(),
            first,
            self.settings.wait_for,
            self.settings.wait_timeout,
            self._stop.is_set,
        )

    def _entries(self) -> Iterator[tuple[int, tuple[str, bytes]]]:
        """Yield the bag's messages, and ticks of the clock between them."""
        period = nanoseconds(1.0 / self.settings.clock_rate)
        tick = 0
        for topic, stamp, data in raw_messages(
            self.path, tuple(self.outputs), self.settings.namespace_in_bag
        ):
            if not 0 <= stamp - tick <= nanoseconds(LONGEST_PAUSE):
                tick = stamp
            while self._clock_output is not None and tick <= stamp:
                yield tick, (CLOCK, b'')
                tick += period
            yield stamp, (topic, data)

    def _deliver(self, stamp: int, entry: tuple[str, bytes], delay: float) -> None:
        topic, data = entry
        if topic == CLOCK:
            self._clock_output.publish(Clock(clock=time_message(ros_messages(), stamp)))
            return
        self.outputs[topic].publish(data)
        self.published[topic] += 1


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(ReplayerNode, args))


if __name__ == '__main__':
    main()
