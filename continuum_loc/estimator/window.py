"""
The window: a chain of columns coupled by intervals.

A column is the body at a knot time; an interval holds the priors and measurements between two.
Each column has a linearisation point and an offset from it. The oldest column is marginalised as
the window moves on; the point at which that happened is pinned (first-estimate Jacobians).
`solver.py` finds the offsets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from math import ceil

from continuum_loc import lie
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator.border import Border
from continuum_loc.estimator.chain import Chain
from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.interpolation import (
    Body,
    body_between,
    motion_bridge,
    motion_jacobians,
)
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import Column, Grid, TIME_EPSILON
from continuum_loc.measurements import Measurement
import numpy as np

# Told of an interval, its columns and the chain before the older column is marginalised.
Forgetting = Callable[[Interval, Column, Column, Chain], None]


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A window's content at one time; `chain` holds what was marginalised."""

    columns: list[Column]
    offsets: list[np.ndarray]
    intervals: list[Interval]
    chain: Chain
    pinned: bool
    moving: bool
    first: Column


class Window:
    """
    Columns and intervals of the newest stretch of time, and what is known of the time before.

    columns: linearisation points; offsets: (D,) from them; chain: their elimination; pinned:
    whether the oldest column carries a marginalised past.
    """

    def __init__(self, grid: Grid, priors: Priors, settings: EstimatorSettings):
        self.grid, self.priors, self.settings = grid, priors, settings
        self.columns: list[Column] = []
        self.offsets: list[np.ndarray] = []
        self.intervals: list[Interval] = []
        self.chain: Chain | None = None
        self.on_forgetting: Forgetting | None = None
        self.pinned = self._moving = False
        self._bias: tuple[np.ndarray, np.ndarray] | None = None
        self._first: Column | None = None  # what the prior of the start is about
        self.wandered = False  # once the body was found: what was known of its base is outdated

    def start(self, column: Column) -> None:
        """Begin with one column at rest."""
        self.columns, self.offsets, self.intervals = [column], [np.zeros(self.grid.dim)], []
        self.forget_past(moving=False)

    def column(self, k: int) -> Column:
        """Estimate column k: its linearisation point moved by its offset."""
        return self.columns[k].retract(self.offsets[k])

    def interval_at(self, time: float) -> Interval:
        """Return the interval (t_k, t_k+1] that holds `time`; new knots are appended as needed."""
        while time > self.columns[-1].time + TIME_EPSILON or not self.intervals:
            self._append()
        k = ceil((time - self.columns[0].time) / self.settings.knot_period - 1e-6) - 1
        return self.intervals[min(max(k, 0), len(self.intervals) - 1)]

    def enter(self, factors: Iterable[Factor], time: float, measurement: Measurement) -> None:
        """
        Put a measurement of `time` [s] into its interval, for those of `factors` that it is for.

        Nothing is counted: what cannot be used, or comes from before the window, is left out.
        """
        for factor in factors:
            if isinstance(measurement, factor.consumes):
                with suppress(MeasurementError):
                    row = factor.row(measurement)
                    at = time - factor.lateness(measurement)
                    if at > self.columns[0].time:
                        self.interval_at(at).add(factor, at, row)

    def border(self, of: Parameters) -> Border:
        """
        Say what the window, as linearised, tells of the constants `of` the robot.

        C is (K, D, P) here: that of each of K columns.
        """
        dim, size = self.grid.dim, of.size
        C = np.zeros((len(self.columns), dim, size))
        total = Border(C, np.zeros((size, size)), np.zeros(size))
        self.priors.bordered(total._replace(C=C[0]), self.columns[0], 1.0, of)
        for k, interval in enumerate(self.intervals):
            one = interval.bordered(self.priors, self.columns[k], self.columns[k + 1], of)
            C[k] += one.C[:dim]
            C[k + 1] += one.C[dim:]
            total.H[:] += one.H
            total.g[:] += one.g
        return total

    def _append(self) -> None:
        newest = self.column(-1)
        self.intervals.append(Interval(newest.time, self.grid.dim, self.grid.nodes))
        self.columns.append(newest.predict(self.settings.knot_period))
        self.offsets.append(np.zeros(self.grid.dim))
        if self.columns[-1].time - self.columns[1].time > self.settings.window - TIME_EPSILON:
            self._marginalise_oldest()

    def _marginalise_oldest(self) -> None:
        oldest = self.intervals[0]
        changed = oldest.changed
        if changed:
            oldest.linearise(self.priors, self.columns[0], self.columns[1])
        self.chain.make_oldest_ready(oldest.normal, changed)
        if self.on_forgetting is not None:
            self.on_forgetting(oldest, self.columns[0], self.columns[1], self.chain)
        self.chain.forget_oldest()
        del self.columns[0], self.offsets[0], self.intervals[0]
        self.pinned = True

    def forget_past(self, moving: bool) -> None:
        """
        Let the oldest column start from the prior alone.

        `moving` says that the body may be in motion there.
        """
        self._moving, self.pinned, self._first = moving, False, self.columns[0]
        self.chain = Chain(self.grid.dim, self._start())
        self.mark_changed()

    def keep_newest(self, count: int) -> None:
        """Shorten the window to `count` intervals and forget what came before."""
        drop = max(len(self.intervals) - count, 0)
        columns = [self.column(k) for k in range(drop, len(self.columns))]
        del self.intervals[:drop]
        self.set_columns(columns)

    def set_columns(self, columns: list[Column]) -> None:
        """Take other columns for the same intervals and forget the past."""
        self.columns = list(columns)
        self.offsets = [np.zeros(self.grid.dim) for _ in columns]
        self.forget_past(moving=True)

    def snapshot(self) -> Kept:
        """Keep what the window knows, for `restore`."""
        return Kept(
            list(self.columns),
            list(self.offsets),
            list(self.intervals),
            self.chain,
            self.pinned,
            self._moving,
            self._first,
        )

    def restore(self, kept: Kept) -> None:
        """Go back to a snapshot; intervals were linearised elsewhere since, so solve again."""
        self.columns, self.offsets = list(kept.columns), list(kept.offsets)
        self.intervals, self.chain = list(kept.intervals), kept.chain
        self.pinned, self._moving, self._first = kept.pinned, kept.moving, kept.first
        self.mark_changed()

    def place(self, shape: Column) -> None:
        """Put the whole window motionless into one shape and forget the past."""
        self.set_columns([shape._replace(time=old.time) for old in self.columns])

    def observe_bias(self, weight: np.ndarray, mean: np.ndarray) -> None:
        """Tell the first column its gyro biases (3 I,), each with a weight."""
        self._bias = weight, mean
        self.linearise_start()
        self.intervals[0].changed = True

    def mark_changed(self) -> None:
        """Have every interval linearised anew."""
        for interval in self.intervals:
            interval.changed = True

    def linearise_start(self) -> None:
        """Linearise what is known of the oldest column anew, where that now is."""
        self.chain.marginals[0] = self._start()

    def _start(self) -> Normal:
        start = self.priors.start(self.columns[0], self._first, self._moving, self.wandered)
        if self._bias is not None:
            weight, mean = self._bias
            at = np.arange(self.grid.bias_offset, self.grid.frame_offset)
            start.H[at, at] += weight
            start.g[at] += weight * (self.columns[0].bias.ravel() - mean)
        return start

    def knot_before(self, time: float) -> int:
        """Return the interval that holds `time`, clipped to the window."""
        k = int(np.searchsorted([column.time for column in self.columns], time - TIME_EPSILON)) - 1
        return min(max(k, 0), len(self.intervals) - 1)

    def body(self, time: float) -> Body:
        """All nodes at `time` in the window."""
        k = self.knot_before(time)
        return body_between(self.column(k), self.column(k + 1), time)

    def frame(self, time: float) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Pose (4, 4) and covariance (6, 6) of a measured base's frame at `time` in the window."""
        if not self.grid.frames:
            return None, None
        k = self.knot_before(time)
        a, b = self.column(k), self.column(k + 1)
        u = (time - a.time) / (b.time - a.time)
        J = np.zeros((6, self.grid.dim))
        J[:, self.grid.frame_rows] = np.eye(6)
        T_map_frame = lie.interpolate(a.T_map_frame[0], b.T_map_frame[0], np.array(u))
        return T_map_frame, self.chain.covariance(k, (1.0 - u) * J, u * J)

    def motion_covariance(self, time: float, nodes: np.ndarray) -> np.ndarray:
        """Covariance (m, 12, 12) of [pose, velocity] of `nodes` (m,) at `time` in the window."""
        k = self.knot_before(time)
        a, b = self.column(k), self.column(k + 1)
        A, B = motion_jacobians(a, b, time, nodes, self.grid.dim)
        own = self.chain.covariance(k, A, B, size=12, step=12)
        velocity_psd = self.intervals[k].jerked[:, None] * self.priors.velocity_psd
        return own + motion_bridge(a, b, time, velocity_psd[nodes])
