"""
Topics, rates, clocks, frames, units and mounts of a graph or a bag, against the description.

Every message goes through the gate that a live node has, and then into the filter with the map.
What a graph says for some seconds is a bag too.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from continuum_loc.estimate import Estimate
from continuum_loc.estimator.filter import SlidingWindowFilter
from continuum_loc.intake import Intake
from continuum_loc.measurements import Measurement, NANOSECONDS, TruthSample
from continuum_loc.robot import RobotDescription
from msg_tools.bag import raw_messages
from msg_tools.factory import deserialize
from msg_tools.topics import INPUTS, TRACKER
import numpy as np

Level = Literal['ok', 'warning', 'error']
RATE_TOLERANCE = 0.2  # share by which a sensor's median rate may differ from the described one
GAP = 5.0  # periods without a sample are a gap
LATE, AHEAD = 0.5, 0.05  # s; from a stamp to the log of its message
APART = 0.1  # s; by which the median delays of two sensors may differ
SUSPECT_SHARE = 0.2  # of the time that a sensor is disbelieved
INLIERS = 0.5  # share of a ToF sensor's zones that fit the map
CONSISTENCY = (0.2, 3.0)


@dataclass(frozen=True)
class Finding:
    """What was found of one matter."""

    level: Level
    matter: str
    text: str


@dataclass
class Heard:
    """Stamps [ns] of one sensor's samples, and the log's [ns]."""

    stamps: list[int] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Median rate [Hz] of the stamps; 0 where there are fewer than two."""
        steps = np.diff(np.sort(np.array(self.stamps)))
        steps = steps[steps > 0]
        return NANOSECONDS / float(np.median(steps)) if len(steps) else 0.0

    @property
    def delay(self) -> float:
        """Median time [s] from a stamp to its log."""
        return float(np.median(np.subtract(self.logged, self.stamps))) / NANOSECONDS

    @property
    def longest_gap(self) -> float:
        """Longest time [s] between two stamps."""
        steps = np.diff(np.sort(np.array(self.stamps)))
        return float(steps.max()) / NANOSECONDS if len(steps) else 0.0


def check_bag(
    bag: Path, filter_: SlidingWindowFilter, namespace: str = '', frame_prefix: str = ''
) -> list[Finding]:
    """Check a bag against the robot description, the map and the settings of a filter."""
    robot = filter_.robot
    intake = Intake(robot, frame_prefix=frame_prefix)
    heard: dict[str, Heard] = defaultdict(Heard)
    estimates = []
    for sample, logged in _passed(bag, intake, namespace):
        mine = heard[name_of(sample)]
        mine.stamps.append(sample.stamp)
        mine.logged.append(logged)
        if not isinstance(sample, TruthSample):
            estimate = filter_.process(sample)
            estimates += [] if estimate is None else [estimate]
    return [
        *_of_sensors(robot, heard),
        *_of_clocks(heard),
        *_of_refusals(intake),
        *_of_estimates(robot, estimates, filter_.setup.prior_map is not None),
    ]


def name_of(sample: Any) -> str:
    """Name the source of a sample: its sensor, or what kind it is of."""
    return getattr(sample, 'sensor', None) or type(sample).__name__.removesuffix('Sample').lower()


def expected_rates(robot: RobotDescription) -> dict[str, float]:
    """Return rates [Hz] of all sources that the description names; 0 where it states none."""
    rates = {one.name: robot.tof_model.rate for one in robot.tof}
    rates |= {one.name: robot.imu_model.rate for one in robot.imu}
    rates |= {one.name: robot.hall_model.rate for one in robot.hall}
    rates |= {one.name: 0.0 for one in robot.trackers}
    if robot.strain is not None:
        rates['strain'] = robot.strain.rate
    if robot.base.insertion.mode == 'measured':
        rates['encoder'] = 0.0
    return rates


def _passed(
    bag: Path, intake: Intake, namespace: str
) -> Iterator[tuple[Measurement | TruthSample, int]]:
    """(sample, log time) of all messages that pass the gate."""

    def mistyped(topic: str, count: int, text: str) -> None:
        intake.refuse('type', text, topic, count)

    for topic, logged, data in raw_messages(bag, (*INPUTS, TRACKER), namespace, mistyped):
        message = intake.parse(topic, data, deserialize)
        sample = None if message is None else intake.accept(topic, message, logged)
        if sample is not None:
            yield sample, logged


def _of_sensors(robot: RobotDescription, heard: dict[str, Heard]) -> Iterator[Finding]:
    expected = expected_rates(robot)
    silent = [name for name in expected if name not in heard]
    if silent:
        yield Finding('error', 'topics', f'nothing usable of {", ".join(silent)}')
    else:
        yield Finding('ok', 'topics', f'all {len(expected)} described sources are heard')
    off = [
        f'{name} comes at {heard[name].rate:.4g} Hz, described as {rate:g}'
        for name, rate in expected.items()
        if name in heard and rate and abs(heard[name].rate / rate - 1.0) > RATE_TOLERANCE
    ]
    for text in off:
        yield Finding('warning', 'rates', text)
    for name, rate in expected.items():
        if name in heard and rate and heard[name].longest_gap > GAP / rate:
            text = f'{name} was silent for {heard[name].longest_gap:.2f} s'
            yield Finding('warning', 'rates', text)
    if not off and not silent:
        yield Finding('ok', 'rates', 'as described')


def _of_clocks(heard: dict[str, Heard]) -> Iterator[Finding]:
    delays = {name: one.delay for name, one in heard.items()}
    if not delays:
        return
    usual, fine = float(np.median(list(delays.values()))), True
    for name, delay in delays.items():
        if delay < -AHEAD:
            text = f'stamps of {name} are {-delay:.3f} s ahead of the log: another clock'
        elif delay > LATE:
            text = f'{name} comes {delay:.3f} s after its stamps: another clock, or a slow way'
        elif abs(delay - usual) > APART:
            text = f'{name} comes {delay:.3f} s after its stamps, the others {usual:.3f} s'
        else:
            continue
        fine = False
        yield Finding('error' if delay < -AHEAD else 'warning', 'clocks', text)
    if fine:
        yield Finding('ok', 'clocks', f'stamps are {1e3 * usual:.0f} ms before the log')


def _of_refusals(intake: Intake) -> Iterator[Finding]:
    """Frames, units and whatever else the gate has refused, with its own words."""
    matters = {'unknown frame': 'frames', 'frame': 'frames', 'value': 'units', 'range': 'units'}
    for (topic, kind), (count, text) in sorted(intake.refusals.items()):
        where = f'{count} messages of {topic or "the bag"} refused, the first: {text}'
        yield Finding('error', matters.get(kind, kind), where)
    if not intake.refusals:
        yield Finding('ok', 'frames, units', 'no message is refused')


def _of_estimates(
    robot: RobotDescription, estimates: list[Estimate], mapped: bool
) -> Iterator[Finding]:
    """How it all fits together: mounts against the map, and sensors against one another."""
    if robot.tof and not mapped:
        yield Finding('warning', 'mounts', 'not checked against a map: none is given (--map)')
    if not estimates:
        yield Finding('error', 'estimate', 'no estimate came of it')
        return
    middle = len(estimates) // 2
    half = estimates[middle:]  # the start settles
    fine = True
    for finding in (*_misfits(half), *_disbelieved(half), *_verdict(half)):
        fine = False
        yield finding
    if fine:
        fit = float(np.median([one.consistency for one in half]))
        yield Finding('ok', 'estimate', f'tracking, consistency {fit:.2f} (1 is honest)')


def _misfits(estimates: list[Estimate]) -> Iterator[Finding]:
    shares = defaultdict(list)
    for one in estimates:
        for name, share in one.inliers.items():
            shares[name].append(share)
    for name, values in shares.items():
        if np.median(values) < INLIERS:
            text = (
                f'{100 * np.median(values):.0f} % of the zones of {name} fit the map: its mount?'
            )
            yield Finding('warning', 'mounts', text)


def _disbelieved(estimates: list[Estimate]) -> Iterator[Finding]:
    times, words = Counter(), {}
    for one in estimates:
        times.update(one.suspects.keys())
        words |= one.suspects
    for name, count in times.items():
        if count > SUSPECT_SHARE * len(estimates):
            share = 100.0 * count / len(estimates)
            yield Finding(
                'warning', 'sensors', f'{name}: {words[name]} ({share:.0f} % of the time)'
            )


def _verdict(estimates: list[Estimate]) -> Iterator[Finding]:
    status = Counter(one.status for one in estimates)
    lost = (status['lost'] + status['initialising']) / len(estimates)
    if lost > 1.0 - SUSPECT_SHARE:
        yield Finding('error', 'estimate', 'it is never found: base, map and mounts?')
    for doubt in dict.fromkeys(doubt for one in estimates for doubt in one.doubts):
        yield Finding('error', 'units, mounts', doubt)
    fit = float(np.median([one.consistency for one in estimates]))
    if not CONSISTENCY[0] < fit < CONSISTENCY[1]:
        text = f'consistency {fit:.2f}: noise is described too {"large" if fit < 1 else "small"}'
        yield Finding('warning', 'estimate', text)
