"""
Node `driver`: raw readings of real sensors, one JSON object a line, onto the graph.

A microcontroller writes what its sensors' own libraries give it to a serial port or a pipe; this
node makes the contract's topics of it (see docs/ros.md and config/driver.yaml).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
import json
import os
import select
import stat
import sys
import threading
from typing import Any

from continuum_loc.errors import MessageError, SettingsError
from continuum_loc.measurements import ImuSample, NANOSECONDS, nanoseconds, StrainSample, TofFrame
from continuum_loc.nodes.support.runtime import output_qos, PackageNode, run
from continuum_loc.nodes.support.settings import DriverNodeSettings
from continuum_loc.robot import load_robot
from msg_tools.drivers import fbg_sample, ism330_sample, vl53l5cx_frame
from msg_tools.factory import ros_messages
from msg_tools.topics import topic_spec

TOPIC_OF = {TofFrame: 'tof/points', ImuSample: 'imu/data_raw', StrainSample: 'strain'}
FORMS = {  # by the field that tells them apart: all fields, those in brackets may be left out
    'distance_mm': 'sensor, distance_mm, target_status, [range_sigma_mm, nb_target_detected]',
    'gyro_raw': 'sensor, gyro_raw, accel_raw',
    'strains': 's, strains',
}
CHUNK = 65536  # bytes
POLL = 0.1  # s; how often a reader without input looks whether it has to stop


class DriverNode(PackageNode):
    """Reads lines in a thread of its own, so that a silent port does not hold up the node."""

    def __init__(self, **options: Any) -> None:
        super().__init__('driver', DriverNodeSettings(), **options)
        self.check_parameters()
        self.robot = load_robot(self.settings.robot)
        self.published: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.outputs = {topic: self._publisher(topic) for topic in TOPIC_OF.values()}
        self._stop = threading.Event()
        self._source = _opened(self.settings.source)
        self._thread = threading.Thread(target=self._read, name='reader', daemon=True)
        self._thread.start()
        self.get_logger().info(f'reading {self.settings.source}')

    def close(self) -> None:
        """Stop reading, and say what came of it."""
        self._stop.set()
        self._thread.join(timeout=5.0)
        os.close(self._source)
        counts = {'published': dict(self.published), 'refused': dict(self.refused)}
        print(f'driver: {json.dumps(counts)}', file=sys.stderr)

    def _publisher(self, topic: str) -> Any:
        spec = topic_spec(topic)
        return self.create_publisher(ros_messages().resolve(spec.type), topic, output_qos(spec))

    def _read(self) -> None:
        for line in _lines(self._source, self._stop.is_set):
            try:
                sample = self._sample(line)
            except MessageError as error:
                self._refuse(error)
                continue
            topic = TOPIC_OF[type(sample)]
            self.outputs[topic].publish(topic_spec(topic).encode(ros_messages(), sample))
            self.published[topic] += 1
        self.finish()

    def _refuse(self, error: MessageError) -> None:
        self.refused[error.kind] += 1
        if self.refused[error.kind] == 1:
            self.get_logger().warning(
                f"{error} [further cases of '{error.kind}' are only counted]"
            )

    def _sample(self, line: bytes) -> TofFrame | ImuSample | StrainSample:
        reading = _reading(line)
        stamp = self._stamp(reading.pop('stamp', None))
        make = {'distance_mm': self._tof, 'gyro_raw': self._imu, 'strains': self._strain}
        form = next((name for name in FORMS if name in reading), None)
        if form is None:
            raise MessageError(
                'fields',
                f'a reading of {", ".join(reading) or "nothing"}; valid: '
                + '; or '.join(FORMS.values()),
            )
        try:
            sample = make[form](stamp, **reading)
        except (TypeError, ValueError) as error:
            if isinstance(error, MessageError):
                raise
            raise MessageError(
                'fields', f'a reading with {form}: {error}; valid: {FORMS[form]}'
            ) from None
        if isinstance(sample, StrainSample):
            return sample
        return replace(sample, sensor=self.settings.frame_prefix + sample.sensor)

    def _stamp(self, given: Any) -> int:
        """Return the reading's own stamp [s], else the clock less the delay, in ns."""
        if given is None:
            return self.now() - nanoseconds(self.settings.delay)
        try:
            return round(float(given) * NANOSECONDS)
        except (TypeError, ValueError, OverflowError):
            raise MessageError('stamp', f'stamp {given!r} is not a number of seconds') from None

    def _tof(self, stamp: int, sensor: str, **raw: Any) -> TofFrame:
        self._require(sensor, self.robot.tof)
        return vl53l5cx_frame(self.robot.tof_model, sensor, stamp, **raw)

    def _imu(self, stamp: int, sensor: str, **raw: Any) -> ImuSample:
        self._require(sensor, self.robot.imu)
        s = self.settings
        return ism330_sample(
            sensor,
            stamp,
            **raw,
            gyro_mdps_per_lsb=s.gyro_mdps_per_lsb,
            accel_mg_per_lsb=s.accel_mg_per_lsb,
        )

    def _strain(self, stamp: int, **raw: Any) -> StrainSample:
        s = self.settings
        return fbg_sample(
            stamp, **raw, core_azimuth_deg=s.core_azimuth_deg, core_radius=s.core_radius
        )

    def _require(self, sensor: str, known: tuple) -> None:
        names = [one.name for one in known]
        if sensor not in names:
            raise MessageError(
                'unknown frame',
                f"robot '{self.robot.name}' has no such sensor '{sensor}'; valid: "
                f'{", ".join(names) or "none of this kind"}',
            )


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


def _lines(source: int, stopped: Callable[[], bool]) -> Iterator[bytes]:
    """Yield the lines that come, until the end of the input or until `stopped()`."""
    rest = b''
    while not stopped():
        if not select.select([source], [], [], POLL)[0]:
            continue
        chunk = os.read(source, CHUNK)
        *lines, rest = (rest + chunk).split(b'\n')
        yield from (line for line in lines if line.strip())
        if not chunk:
            break
    if rest.strip():
        yield rest


def _reading(line: bytes) -> dict[str, Any]:
    try:
        reading = json.loads(line)
    except ValueError as error:
        raise MessageError('line', f'not JSON ({error}): {line[:60]!r}') from None
    if not isinstance(reading, dict):
        raise MessageError('line', f'a {type(reading).__name__}, not an object: {line[:60]!r}')
    return reading


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run(DriverNode, args))


if __name__ == '__main__':
    main()
