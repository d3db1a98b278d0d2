"""
Faults on request: each wraps the samples of a simulator or a bag and yields faulty ones.

    faulty = Dropout(sensors=("ring2_*",), probability=0.3, seed=1)(samples)

`sensors` are patterns of source names: a sensor's own name, `strain` or `joint_states`. Times are
seconds from the stream's first stamp. Truth passes untouched. Samples are yielded in order of
arrival: a delay or a wrong clock makes their stamps go back, as on a real bus. Wrong mounting is
no matter of the stream: see `miscalibrated`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
import heapq
import itertools
from typing import Any

from continuum_loc import lie
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    NANOSECONDS,
    nanoseconds,
    seconds,
    StrainSample,
    TOF_VALID,
    TofFrame,
    TruthSample,
)
from continuum_loc.robot import mounted, RobotDescription, Sensor
import numpy as np


def source(sample: Any) -> str:
    """Name what a sample comes from: a sensor, `strain`, `joint_states`, `base`, `truth`."""
    kinds = {
        StrainSample: 'strain',
        EncoderSample: 'joint_states',
        BaseSample: 'base',
        TruthSample: 'truth',
    }
    return kinds.get(type(sample)) or sample.sensor


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Base of all: `alter` changes samples of chosen sensors in [start, end), or drops them."""

    sensors: tuple[str, ...] = ('*',)
    start: float = 0.0
    end: float = float('inf')
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.start < self.end:
            raise ValueError(
                f'{type(self).__name__}: start {self.start} s must come before end {self.end} s'
            )

    def __call__(self, stream: Iterable[Any]) -> Iterator[Any]:
        rng, epoch = np.random.default_rng(self.seed), None
        memory: dict[str, Any] = {}
        for sample in stream:
            epoch = sample.stamp if epoch is None else epoch
            if self.strikes(sample, epoch):
                sample = self.alter(sample, rng, memory)
            elif not isinstance(sample, TruthSample):
                memory[source(sample)] = sample
            if sample is not None:
                yield sample

    def strikes(self, sample: Any, epoch: int) -> bool:
        """Whether the sample is one of the chosen sensors', while the fault is present."""
        if (
            isinstance(sample, TruthSample)
            or not self.start <= seconds(sample.stamp, epoch) < self.end
        ):
            return False
        return any(fnmatchcase(source(sample), pattern) for pattern in self.sensors)

    def alter(self, sample: Any, rng: np.random.Generator, memory: dict[str, Any]) -> Any | None:
        """Return the faulty sample; `memory` holds each source's last one before the fault."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Dropout(Fault):
    """Samples are lost, each with `probability`."""

    probability: float = 1.0

    def alter(self, sample, rng, memory):
        return None if rng.random() < self.probability else sample


@dataclass(frozen=True, kw_only=True)
class Freeze(Fault):
    """The sensor repeats its last good values under new stamps."""

    def alter(self, sample, rng, memory):
        held = memory.setdefault(source(sample), sample)
        return replace(held, stamp=sample.stamp)


@dataclass(frozen=True, kw_only=True)
class BiasStep(Fault):
    """From `start` on a constant is added [rad/s, m/s^2, T]."""

    gyro: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accelerometer: tuple[float, float, float] = (0.0, 0.0, 0.0)
    field: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def alter(self, sample, rng, memory):
        if isinstance(sample, ImuSample):
            return replace(
                sample,
                angular_velocity=sample.angular_velocity + self.gyro,
                linear_acceleration=sample.linear_acceleration + self.accelerometer,
            )
        if isinstance(sample, FieldSample):
            return replace(sample, field=sample.field + self.field)
        return sample


@dataclass(frozen=True, kw_only=True)
class Outliers(Fault):
    """
    Each valid ToF zone, with `probability`, reads a range drawn evenly from `ranges` [m].

    It is still called valid. IMU samples get, with the same probability, a spike of `gyro_spike`
    rad/s about a random axis.
    """

    probability: float = 0.05
    ranges: tuple[float, float] = (0.05, 4.0)
    gyro_spike: float = 3.0

    def alter(self, sample, rng, memory):
        if isinstance(sample, TofFrame):
            return self._tof(sample, rng)
        if isinstance(sample, ImuSample):
            axis = rng.standard_normal(3)
            spike = (
                self.gyro_spike * axis / np.linalg.norm(axis) * (rng.random() < self.probability)
            )
            return replace(sample, angular_velocity=sample.angular_velocity + spike)
        return sample

    def _tof(self, frame: TofFrame, rng: np.random.Generator) -> TofFrame:
        drawn = rng.uniform(*self.ranges, frame.ranges.shape)
        hit = (rng.random(frame.ranges.shape) < self.probability) & (frame.status == TOF_VALID)
        scale = np.where(hit, drawn / np.where(hit, frame.ranges, 1.0), 1.0)
        return replace(frame, ranges=frame.ranges * scale, points=frame.points * scale[:, None])


@dataclass(frozen=True, kw_only=True)
class ClockOffset(Fault):
    """A wrong clock: stamps are late by `offset` s, `jitter` s (1 sigma), `drift` in s/s."""

    offset: float = 0.0
    jitter: float = 0.0
    drift: float = 0.0

    def alter(self, sample, rng, memory):
        since = seconds(sample.stamp, memory.setdefault('first stamp', sample.stamp))
        error = self.offset + self.drift * since + self.jitter * rng.standard_normal()
        return replace(sample, stamp=sample.stamp + nanoseconds(error))


@dataclass(frozen=True, kw_only=True)
class Delay(Fault):
    """Samples with right stamps come late by `delay` s and `jitter` s (1 sigma), never early."""

    delay: float = 0.05
    jitter: float = 0.0

    def __call__(self, stream: Iterable[Any]) -> Iterator[Any]:
        rng, epoch = np.random.default_rng(self.seed), None
        waiting: list[tuple[float, int, Any]] = []  # by arrival, ties in the order of the stream
        for order, sample in zip(itertools.count(), stream):
            epoch = sample.stamp if epoch is None else epoch
            late = (
                max(0.0, self.delay + self.jitter * rng.standard_normal())
                if self.strikes(sample, epoch)
                else 0.0
            )
            heapq.heappush(waiting, (sample.stamp + late * NANOSECONDS, order, sample))
            while waiting and waiting[0][0] <= sample.stamp:
                yield heapq.heappop(waiting)[2]
        while waiting:
            yield heapq.heappop(waiting)[2]


def miscalibrated(
    robot: RobotDescription,
    position_sigma: float,
    rotation_sigma_deg: float,
    seed: int,
    sensors: tuple[str, ...] = ('*',),
) -> RobotDescription:
    """
    Mount every chosen sensor a little wrong, for `World`; estimate with the nominal robot.

    position_sigma: m, rotation_sigma_deg: deg, both per axis (1 sigma).
    """
    rng = np.random.default_rng(seed)
    sigma = np.repeat([position_sigma, np.radians(rotation_sigma_deg)], 3)

    def moved(sensor: Sensor) -> Sensor:
        # Drawn for every sensor, so that the choice does not shift the rest.
        error = sigma * rng.standard_normal(6)
        if not any(fnmatchcase(sensor.name, pattern) for pattern in sensors):
            return sensor
        return sensor.model_copy(
            update={'mount': mounted(sensor.mount.T_ring_sensor @ lie.exp(error))}
        )

    kinds = ('tof', 'imu', 'hall', 'trackers')
    groups = {kind: tuple(moved(sensor) for sensor in getattr(robot, kind)) for kind in kinds}
    return robot.model_copy(update=groups)
