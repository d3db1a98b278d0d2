"""
The window: a chain of columns coupled by intervals.

A column is the body at a knot time; an interval holds the priors and measurements between two.

Each column has a linearisation point and an offset from it; a solve gives all offsets at once. A
column that moved far is linearised anew, together with the intervals that touch it; the others
keep their normal equations, and the chain keeps its elimination up to the first that changed. The
oldest column is marginalised as the window moves on; the point at which that happened is pinned
(first-estimate Jacobians).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

from continuum_loc.errors import SingularError
from continuum_loc.estimator.chain import Chain
from continuum_loc.estimator.interpolation import (
    blended_step,
    Body,
    body_between,
    motion_bridge,
    motion_jacobians,
)
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import Column, Grid, NODE_DIM, POSE_PART, TIME_EPSILON
import numpy as np

DAMPING_LIMIT = 1e4
# Relative: associations change between iterations, so costs compare only so well.
COST_SLACK = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A window's content at one time; `chain` holds what was marginalised."""

    columns: list[Column]
    offsets: list[np.ndarray]
    intervals: list[Interval]
    chain: Chain
    pinned: bool
    moving: bool


class Window:
    """Columns, offsets and intervals, and the optimisation over them."""

    def __init__(self, grid: Grid, priors: Priors, settings: EstimatorSettings):
        self.grid, self.priors, self.settings = grid, priors, settings
        self.columns: list[Column] = []
        self.offsets: list[np.ndarray] = []
        self.intervals: list[Interval] = []
        self.chain: Chain | None = None
        self.pinned = False  # whether the oldest column carries a marginalised past
        self._moving = False
        self._bias: tuple[np.ndarray, np.ndarray] | None = None

    # ---------------------------------------------------------- the stretch of time that it covers

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
        self.chain.forget_oldest(oldest.normal, changed)
        del self.columns[0], self.offsets[0], self.intervals[0]
        self.pinned = True

    def forget_past(self, moving: bool) -> None:
        """
        Let the oldest column start from the prior alone.

        `moving` says that the body may be in motion there.
        """
        self._moving, self.pinned = moving, False
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
        )

    def restore(self, kept: Kept) -> None:
        """Go back to a snapshot and solve again: intervals were linearised elsewhere since."""
        self.columns, self.offsets = list(kept.columns), list(kept.offsets)
        self.intervals, self.chain = list(kept.intervals), kept.chain
        self.pinned, self._moving = kept.pinned, kept.moving
        self.mark_changed()
        self.track()

    def place(self, shape: Column) -> None:
        """Put the whole window motionless into one shape and forget the past."""
        self.set_columns([shape._replace(time=old.time) for old in self.columns])

    def observe_bias(self, weight: np.ndarray, mean: np.ndarray) -> None:
        """Tell the first column its gyro biases (3 I,), each with a weight."""
        self._bias = weight, mean
        self.chain.marginals[0] = self._start()
        self.intervals[0].changed = True

    def mark_changed(self) -> None:
        """Have every interval linearised anew."""
        for interval in self.intervals:
            interval.changed = True

    def _start(self) -> Normal:
        start = self.priors.start(self.columns[0], self._moving)
        if self._bias is not None:
            weight, mean = self._bias
            at = np.arange(self.grid.bias_offset, self.grid.dim)
            start.H[at, at] += weight
            start.g[at] += weight * (self.columns[0].bias.ravel() - mean)
        return start

    # ------------------------------------------------------------------ Gauss-Newton

    def track(self, time: float | None = None) -> tuple[int, bool]:
        """
        Iterate from next to the minimum: (iterations, whether it converged).

        `time`: the newest instant that will be asked for; by default that of the newest column.
        The columns around it are judged by the body there: ahead of the data the newest one swings
        from iteration to iteration with the weight of its step, and nobody hears of it.
        Raises SingularError.
        """
        first, limit = len(self.intervals), self.settings.solver.max_iterations
        for iteration in range(1, limit + 1):
            first = min(first, self._linearise())
            offsets = self._solve(first, 0.0)
            move = self._largest_move(offsets, time)
            first = self._move(offsets)
            if move < self.settings.solver.tolerance or first == len(self.intervals):
                return iteration, True  # what was linearised where it is, is solved exactly
        return limit, False

    def acquire(self, narrow: Callable[[int], bool]) -> tuple[int, bool]:
        """
        Iterate from a guess, damped whenever the cost rises: (iterations, whether it converged).

        narrow(iteration) tightens the association before each iteration; True once it is as tight
        as when tracking.
        """
        damping, limit = 0.0, self.settings.solver.acquisition_iterations
        for iteration in range(1, limit + 1):
            tight = narrow(iteration)
            first = 0 if damping > 0.0 else len(self.intervals)
            first = min(first, self._linearise())
            columns, offsets, cost = self.columns.copy(), self.offsets.copy(), self._cost()
            try:
                solved = self._solve(first, damping)
            except SingularError:
                damping = max(10.0 * damping, 1e-4)
                continue
            move = self._largest_move(solved)
            self._move(solved)
            self._linearise()
            if self._cost() > cost * (1.0 + COST_SLACK) + 1.0:
                self._undo(columns, offsets)
                damping = max(10.0 * damping, 1e-3)
            elif move < self.settings.solver.tolerance and tight:
                break
            else:
                damping = 0.1 * damping if damping > 1e-3 else 0.0
            if damping > DAMPING_LIMIT:
                break
        self._linearise()
        self._solve(0, 0.0)  # the covariance must not know of the damping
        return iteration, iteration < limit and damping <= DAMPING_LIMIT

    def _solve(self, first: int, damping: float) -> list[np.ndarray]:
        return self.chain.solve([interval.normal for interval in self.intervals], first, damping)

    def _linearise(self) -> int:
        """Linearise the intervals that changed; the first of them."""
        changed = [k for k, interval in enumerate(self.intervals) if interval.changed]
        for k in changed:
            self.intervals[k].linearise(self.priors, self.columns[k], self.columns[k + 1])
        return changed[0] if changed else len(self.intervals)

    def _move(self, offsets: list[np.ndarray]) -> int:
        """Take the offsets, relinearise columns that moved far; the first interval affected."""
        first = len(self.intervals)
        moves = np.abs(self._by_node(offsets)[:, :, POSE_PART]).max(axis=(1, 2))
        far = moves >= self.settings.solver.relinearise
        for k, offset in enumerate(offsets):
            if (k == 0 and self.pinned) or not far[k]:
                self.offsets[k] = offset
                continue
            self.columns[k] = self.columns[k].retract(offset)
            self.offsets[k] = np.zeros(self.grid.dim)
            if k == 0:
                self.chain.marginals[0] = self._start()
            for touched in (k - 1, k):
                if 0 <= touched < len(self.intervals):
                    self.intervals[touched].changed = True
                    first = min(first, touched)
        return first

    def _undo(self, columns: list[Column], offsets: list[np.ndarray]) -> None:
        """Back to where a failed step started."""
        moved = [old is not new for old, new in zip(columns, self.columns, strict=True)]
        self.columns, self.offsets = columns, offsets
        for k, interval in enumerate(self.intervals):
            interval.changed = interval.changed or moved[k] or moved[k + 1]
        if moved[0]:
            self.chain.marginals[0] = self._start()

    def _largest_move(self, offsets: list[np.ndarray], time: float | None = None) -> float:
        """Largest pose component [m, rad] of the step to these offsets, up to `time`."""
        step = self._by_node(offsets) - self._by_node(self.offsets)
        pose = step[:, :, POSE_PART]
        if time is not None:
            k = self.knot_before(time)
            a, b = self.columns[k].time, self.columns[k + 1].time
            pose = pose[: k + 2]
            pose[k + 1] = blended_step(step[k], step[k + 1], b - a, time - a)
        return float(np.abs(pose).max())

    def _by_node(self, offsets: list[np.ndarray]) -> np.ndarray:
        """(K, N, 18) offsets of the columns' nodes."""
        nodes = np.array(offsets)[:, : self.grid.bias_offset]
        return nodes.reshape(len(offsets), -1, NODE_DIM)

    def _cost(self) -> float:
        """Robust cost where linearised, and by the quadratic model at the offsets."""
        start, x = self.chain.marginals[0], self.offsets[0]
        total = float(start.g @ x) + start.half_square(x)
        return total + sum(
            interval.modelled_cost(self.offsets[k], self.offsets[k + 1])
            for k, interval in enumerate(self.intervals)
        )

    # ------------------------------------------------------------------ the body in it

    def knot_before(self, time: float) -> int:
        """Return the interval that holds `time`, clipped to the window."""
        k = int(np.searchsorted([column.time for column in self.columns], time - TIME_EPSILON)) - 1
        return min(max(k, 0), len(self.intervals) - 1)

    def body(self, time: float) -> Body:
        """All nodes at `time` in the window."""
        k = self.knot_before(time)
        return body_between(self.column(k), self.column(k + 1), time)

    def motion_covariance(self, time: float, nodes: np.ndarray) -> np.ndarray:
        """Covariance (m, 12, 12) of [pose, velocity] of `nodes` (m,) at `time` in the window."""
        k = self.knot_before(time)
        a, b = self.column(k), self.column(k + 1)
        A, B = motion_jacobians(a, b, time, nodes, self.grid.dim)
        own = self.chain.covariance(k, A, B, size=12, step=12)
        velocity_psd = self.intervals[k].jerked[:, None] * self.priors.velocity_psd
        return own + motion_bridge(a, b, time, velocity_psd[nodes])
