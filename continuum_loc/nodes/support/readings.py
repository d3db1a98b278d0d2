"""
Lines of JSON from a microcontroller -> measurements, for node `driver`.

Nothing here imports rclpy, so that all lines there may be are tried without a graph.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
import json
import os
import select
import stat
from typing import Any

from continuum_loc.errors import MessageError, RunFailure
from continuum_loc.measurements import ImuSample, nanoseconds, StrainSample, TofFrame
from continuum_loc.nodes.support.settings import DriverNodeSettings
from continuum_loc.robot import RobotDescription
from msg_tools.drivers import fbg_sample, ism330_sample, vl53l5cx_frame
from msg_tools.geometry import LAST_SECOND

FORMS = {  # by the field that tells them apart: all fields, those in brackets may be left out
    'distance_mm': 'sensor, distance_mm, target_status, [range_sigma_mm, nb_target_detected]',
    'gyro_raw': 'sensor, gyro_raw, accel_raw',
    'strains': 's, strains',
}
# What a stamp that is none is likely to be in.
UNITS = ((1e17, ' (nanoseconds?)'), (1e14, ' (microseconds?)'), (1e11, ' (milliseconds?)'))
CHUNK = 65536  # bytes
POLL = 0.1  # s; how often a reader without input looks whether it has to stop
MEMORY = 1  # major number of devices as /dev/null
SHOWN = 60  # bytes of a line in what is said of it
MOST_SAID = 400  # characters


class Readings:
    """
    Makes measurements of lines.

    clock: ns, for readings without a stamp of their own.
    """

    def __init__(
        self, robot: RobotDescription, settings: DriverNodeSettings, clock: Callable[[], int]
    ) -> None:
        self.settings, self._clock = settings, clock
        self._tof_model = robot.tof_model
        self._make = {'distance_mm': self._tof, 'gyro_raw': self._imu, 'strains': self._strain}

    def sample(self, line: bytes) -> TofFrame | ImuSample | StrainSample:
        """
        Return the measurement of a line.

        Raises MessageError, and nothing else, for any other line.
        """
        try:
            return self._sample(line)
        except MessageError as error:
            raise MessageError(error.kind, str(error)[:MOST_SAID]) from None
        except Exception as error:  # whatever is wrong with a line, the next may be right
            said = f'{type(error).__name__}: {error}'[:MOST_SAID]
            raise MessageError('line', f'{said}: {line[:SHOWN]!r}') from None

    def _sample(self, line: bytes) -> TofFrame | ImuSample | StrainSample:
        reading = parsed(line, self.settings.longest_line)
        stamp = self._stamp(reading.pop('stamp', None))
        form = next((name for name in FORMS if name in reading), None)
        if form is None:
            raise MessageError(
                'fields',
                f'a reading of {", ".join(reading) or "nothing"}; valid: '
                + '; or '.join(FORMS.values()),
            )
        if not isinstance(reading.get('sensor', ''), str):
            raise MessageError('fields', f"a sensor's name cannot be {reading['sensor']!r}")
        try:
            return self._make[form](stamp, **reading)
        except TypeError as error:
            raise MessageError(
                'fields', f'a reading with {form}: {error}; valid: {FORMS[form]}'
            ) from None

    def _stamp(self, given: Any) -> int:
        """Return the reading's own stamp [s], else the clock less the delay, in ns."""
        if given is None:
            return self._clock() - nanoseconds(self.settings.delay)
        if isinstance(given, bool) or not isinstance(given, (int, float)):
            raise MessageError('stamp', f'stamp {given!r} is not a number of seconds')
        if not 0 < given <= LAST_SECOND:
            unit = next((name for least, name in UNITS if given >= least), '')
            raise MessageError(
                'stamp',
                f'stamp {str(given)[:20]} is no time in seconds{unit}; valid: 0 to {LAST_SECOND}',
            )
        return nanoseconds(given)

    def _tof(self, stamp: int, sensor: str, **raw: Any) -> TofFrame:
        return vl53l5cx_frame(self._tof_model, sensor, stamp, **raw)

    def _imu(self, stamp: int, sensor: str, **raw: Any) -> ImuSample:
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


def parsed(line: bytes, longest: int) -> dict[str, Any]:
    """Return the JSON object of a line. Raises MessageError for any other line."""
    if len(line) > longest:
        raise MessageError('line', f'a line of more than {longest} bytes: {line[:SHOWN]!r}')
    try:
        reading = json.loads(line, parse_constant=_no_number, object_pairs_hook=_once)
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError('line', f'not JSON ({error}): {line[:SHOWN]!r}') from None
    except RecursionError:
        raise MessageError('line', f'nested too deeply: {line[:SHOWN]!r}') from None
    if not isinstance(reading, dict):
        raise MessageError('line', f'a {type(reading).__name__}, not an object: {line[:SHOWN]!r}')
    return reading


def _no_number(text: str) -> None:
    raise MessageError('value', f'{text} is no reading')


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = Counter(name for name, _ in pairs)
        raise MessageError('fields', f'given twice: {names.most_common(1)[0][0]}')
    return found


def lines(source: int, stopped: Callable[[], bool], longest: int) -> Iterator[bytes]:
    """
    Yield the lines of a file descriptor, until their end or until `stopped()`.

    Of a line of more than `longest` bytes only the beginning comes, itself longer than that: the
    rest is not kept. Raises RunFailure where the source fails, as a port does that is pulled out.
    """
    rest, skipping = b'', False
    while not stopped():
        if not select.select([source], [], [], POLL)[0]:
            continue
        try:
            chunk = os.read(source, CHUNK)
        except OSError as error:
            raise RunFailure(f'the source cannot be read any more ({error.strerror})') from None
        first, *others = (rest + chunk).split(b'\n')
        *whole, rest = [b'' if skipping and others else first, *others]
        skipping = skipping and not others
        yield from (line for line in whole if line.strip())
        if len(rest) > longest and not skipping:
            yield rest
            skipping = True
        rest = b'' if skipping else rest
        if not chunk:
            if _hung_up(source):
                raise RunFailure('the source is a port that has gone')
            break
    if rest.strip():
        yield rest


def _hung_up(source: int) -> bool:
    """Whether an end is that of a port which was pulled out; one that was typed is an end."""
    state = os.fstat(source)
    device = stat.S_ISCHR(state.st_mode) and os.major(state.st_rdev) != MEMORY
    return device and not os.isatty(source)
