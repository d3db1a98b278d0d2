"""
Sensors that are not quite what their description says: wrappers of a stream of samples.

As faults they act on samples from the simulator or from a bag; what each sensor departs by is
drawn when it is first heard, from a stream that its name and the seed decide.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any
import zlib

from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    seconds,
    StrainSample,
    TofFrame,
)
from continuum_loc.simulator.faults import Fault, source
import numpy as np


@dataclass(frozen=True, kw_only=True)
class _Departure(Fault):
    """Base: `own` draws what a sensor departs by, once per stream."""

    def alter(self, sample, rng, memory):
        key = ('own', source(sample))
        if key not in memory:
            name = zlib.crc32(source(sample).encode())
            memory[key] = self.own(np.random.default_rng([self.seed, name]), sample)
        return self.depart(sample, memory[key])

    def own(self, rng: np.random.Generator, sample: Any) -> Any:
        """Draw what the sensor of `sample` departs by."""
        raise NotImplementedError

    def depart(self, sample: Any, own: Any) -> Any:
        """Return the sample as such a sensor gives it."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class RangeErrors(_Departure):
    """
    Each ToF unit has an offset [m] and a scale on the distance that it measures.

    cosine: (Z,) of that distance over the range along the ray; 1 where it is the range.
    """

    offset: float = 0.0
    scale: float = 0.0
    cosine: np.ndarray | float = field(default=1.0, compare=False)

    def own(self, rng, sample):
        return rng.standard_normal(2) * (self.offset, self.scale)

    def depart(self, sample, own):
        if not isinstance(sample, TofFrame):
            return sample
        ranges = np.maximum((1.0 + own[1]) * sample.ranges + own[0] / self.cosine, 0.0)
        finite = np.isfinite(sample.ranges)
        ratio = np.divide(ranges, sample.ranges, out=np.ones_like(ranges), where=finite)
        ranges = np.where(finite, ranges, sample.ranges)
        return replace(sample, ranges=ranges, points=sample.points * ratio[:, None])


@dataclass(frozen=True, kw_only=True)
class GyroErrors(_Departure):
    """
    Gyros with scales, axes that are off by `axes_deg`, a bias that wanders.

    walk: of the bias [rad/s/sqrt(s)]. limit: full scale [rad/s].
    """

    scale: float = 0.0
    axes_deg: float = 0.0
    bias: float = 0.0
    walk: float = 0.0
    limit: float = float('inf')

    def own(self, rng, sample):
        return _Wandering(
            _mixing(rng, self.scale, self.axes_deg),
            self.bias * rng.standard_normal(3),
            sample.stamp,
            rng,
        )

    def depart(self, sample, own):
        if not isinstance(sample, ImuSample):
            return sample
        elapsed = max(0.0, seconds(sample.stamp, own.stamp))
        own.bias = own.bias + self.walk * np.sqrt(elapsed) * own.rng.standard_normal(3)
        own.stamp = sample.stamp
        turned = own.mixing @ sample.angular_velocity + own.bias
        return replace(sample, angular_velocity=np.clip(turned, -self.limit, self.limit))


@dataclass(eq=False)
class _Wandering:
    """A gyro's axes (3, 3), its bias (3,) at `stamp`, and what moves it."""

    mixing: np.ndarray
    bias: np.ndarray
    stamp: int
    rng: np.random.Generator


@dataclass(frozen=True, kw_only=True)
class StrainErrors(_Departure):
    """
    A fibre with a scale, twisted about the backbone, with curvatures where it is straight.

    Curvature and plane are one complex number kappa exp(i theta), which is scaled, turned and
    shifted.
    """

    scale: float = 0.0
    twist_deg: float = 0.0
    offset: float = 0.0

    def own(self, rng, sample):
        scale, twist, real, imaginary = rng.standard_normal(4)
        turn = np.exp(1j * np.radians(self.twist_deg * twist))
        return (1.0 + self.scale * scale) * turn, self.offset * (real + 1j * imaginary)

    def depart(self, sample, own):
        if not isinstance(sample, StrainSample):
            return sample
        bent = own[0] * sample.kappa * np.exp(1j * sample.theta) + own[1]
        return replace(sample, theta=np.angle(bent), kappa=np.abs(bent))


@dataclass(frozen=True, kw_only=True)
class HallErrors(_Departure):
    """
    Hall sensors with scales, axes and offsets of their own, which drift while they warm up.

    What is saturated stays so.
    """

    scale: float = 0.0
    axes_deg: float = 0.0
    offset: float = 0.0
    warm_scale: float = 0.0
    warm_offset: float = 0.0
    warm_time: float = 300.0

    def own(self, rng, sample):
        mixing = _mixing(rng, self.scale, self.axes_deg)
        offset, warm, warm_offset = rng.standard_normal((3, 3))
        return (
            mixing,
            self.offset * offset,
            self.warm_scale * warm,
            self.warm_offset * warm_offset,
            sample.stamp,
        )

    def depart(self, sample, own):
        if not isinstance(sample, FieldSample):
            return sample
        mixing, offset, warm_scale, warm_offset, start = own
        warmth = 1.0 - np.exp(-max(0.0, seconds(sample.stamp, start)) / self.warm_time)
        read = mixing @ np.nan_to_num(sample.field) + offset
        read = (1.0 + warmth * warm_scale) * read + warmth * warm_offset
        return replace(sample, field=np.where(np.isfinite(sample.field), read, np.nan))


@dataclass(frozen=True, kw_only=True)
class Backlash(_Departure):
    """
    Drives that turn by `play` [m] before their tendons follow.

    The encoder sits at the drive: it leads the tendon by half of the play in the direction in
    which it went last. The insertion has none.
    """

    play: float = 0.0

    def own(self, rng, sample):
        return _Play()

    def depart(self, sample, own):
        if not isinstance(sample, EncoderSample):
            return sample
        before = sample.position if own.position is None else own.position
        own.lead = np.clip(own.lead + sample.position - before, -self.play / 2.0, self.play / 2.0)
        own.position = sample.position
        tendon = np.array([name != 'insertion' for name in sample.names])
        return replace(sample, position=sample.position + np.where(tendon, own.lead, 0.0))


@dataclass(eq=False)
class _Play:
    """Where the tendons were, and by how much their drives lead them."""

    position: np.ndarray | None = None
    lead: np.ndarray | float = 0.0


def _mixing(rng: np.random.Generator, scale: float, axes_deg: float) -> np.ndarray:
    """(3, 3) rows: axes as they are, each turned from its place and scaled."""
    across = np.radians(axes_deg) * rng.standard_normal((3, 3))
    np.fill_diagonal(across, 0.0)
    axes = np.eye(3) + across
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return (1.0 + scale * rng.standard_normal(3))[:, None] * axes
