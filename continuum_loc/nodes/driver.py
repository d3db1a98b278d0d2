"""
Node `driver`: raw readings of real sensors, one JSON object a line, onto the graph.

A microcontroller writes what its sensors' own libraries give it to a serial port or a pipe; this
node makes the contract's topics of it (see docs/ros.md and config/driver.yaml).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
import json
import os
import stat
import sys
import threading
from typing import Any

from continuum_loc.errors import MessageError, SettingsError
from continuum_loc.intake import Intake
from continuum_loc.measurements import ImuSample, StrainSample, TofFrame
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.readings import lines, Readings
from continuum_loc.nodes.support.runtime import run
from continuum_loc.nodes.support.settings import DriverNodeSettings
from continuum_loc.robot import load_robot
from msg_tools.factory import ros_messages
from msg_tools.topics import topic_spec

TOPIC_OF = {TofFrame: 'tof/points', ImuSample: 'imu/data_raw', StrainSample: 'strain'}


class DriverNode(PackageNode):
    """Reads lines in a thread of its own, so that a silent port does not hold up the node."""

    def __init__(self, **options: Any) -> None:
        super().__init__('driver', DriverNodeSettings(), **options)
        self.check_parameters()
        robot = load_robot(self.settings.robot)
        self.published: Counter[str] = Counter()
        self.intake = Intake(robot, report=self._tell)
        self.readings = Readings(robot, self.settings, self.now)
        self.outputs: dict[str, Any] = {}
        self._stop = threading.Event()

    def configure(self) -> None:
        """Make the outputs."""
        self.outputs = {topic: self.publisher(topic) for topic in TOPIC_OF.values()}

    def activate(self) -> None:
        """Open the source, and read it."""
        self._source = _opened(self.settings.source)
        self._stop.clear()
        reader = self.thread(self._read, 'reader')
        reader.start()
        self.undo(self._stop_reading, reader)
        self.get_logger().info(f'reading {self.settings.source}')

    def _stop_reading(self, reader: threading.Thread) -> None:
        self._stop.set()
        reader.join(timeout=5.0)
        os.close(self._source)

    def close(self) -> None:
        """Say what came of it."""
        counts = {'published': dict(self.published), 'refused': dict(self.intake.refused)}
        print(f'driver: {json.dumps(counts)}', file=sys.stderr)

    def _read(self) -> None:
        for line in lines(self._source, self._stop.is_set, self.settings.longest_line):
            self.readings.settings = self.settings  # which may have changed
            try:
                topic, message = self._message(line)
            except MessageError as error:
                self.intake.refuse(error.kind, str(error))
            else:
                self.outputs[topic].publish(message)
                self.published[topic] += 1
        if not self._stop.is_set():
            self.finish()

    def _tell(self, kind: str, text: str) -> None:
        self.get_logger().warning(f"{text} [further cases of '{kind}' are only counted]")

    def _message(self, line: bytes) -> tuple[str, Any]:
        sample = self.readings.sample(line)
        topic = TOPIC_OF[type(sample)]
        self.intake.check(topic, sample)
        if not isinstance(sample, StrainSample):
            sample = replace(sample, sensor=self.settings.frame_prefix + sample.sensor)
        return topic, topic_spec(topic).encode(ros_messages(), sample)


def _opened(source: str) -> int:
    """Open a file, pipe or serial port (set up by `stty`); `-` is the standard input."""
    if source == '-':
        return os.dup(sys.stdin.fileno())
    try:
        # A named pipe that is open for writing too neither blocks nor ends between its writers.
        way = os.O_RDWR if stat.S_ISFIFO(os.stat(source).st_mode) else os.O_RDONLY
        return os.open(source, way | os.O_NOCTTY)
    except OSError as error:
        raise SettingsError(
            f"parameter 'source': cannot read '{source}' ({error.strerror}); give a serial port, "
            'a pipe, a file, or - for the standard input'
        ) from None


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(DriverNode, args))


if __name__ == '__main__':
    main()
