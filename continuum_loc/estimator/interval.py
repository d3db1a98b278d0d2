"""The stretch between two knots: its measurements, and their normal equations where linearised."""

from __future__ import annotations

from continuum_loc.estimator.border import Border
from continuum_loc.estimator.factors import ClockScores, Factor, FactorReport
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.state import Column
import numpy as np


class Interval:
    """
    Measurements with stamps in (start, start + duration], by factor, and what they come to.

    normal, cost: at the current linearisation; reports: how each factor's measurements fit there;
    jerked: (N,) what the process noise of each node is multiplied by; changed: to be linearised
    anew.
    """

    def __init__(self, start: float, dim: int, nodes: int):
        self.start, self.changed = start, True
        self.normal, self.cost = Normal.zeros(2 * dim), 0.0
        self.reports: dict[Factor, FactorReport] = {}
        self.jerked = np.ones(nodes)
        self._times: dict[Factor, list[float]] = {}
        self._rows: dict[Factor, list[tuple]] = {}
        self._batches: dict[Factor, tuple] = {}
        self._scores: dict[Factor, ClockScores | None] = {}

    def add(self, factor: Factor, time: float, row: tuple) -> None:
        """Take a factor's row at `time` [s since the filter's epoch]."""
        self._times.setdefault(factor, []).append(time - self.start)
        self._rows.setdefault(factor, []).append(row)
        self._batches.pop(factor, None)
        self.changed = True

    def clear(self) -> None:
        """Forget all rows, to be read anew; how they fitted is told until then."""
        for kept in (self._times, self._rows, self._batches, self._scores):
            kept.clear()
        self.changed = True

    def rows(self, factor: Factor) -> list[tuple]:
        """Rows of one factor, in order of arrival."""
        return self._rows.get(factor, [])

    def linearise(self, priors: Priors, a: Column, b: Column) -> None:
        """Build the normal equations at the columns a and b."""
        self.normal.clear()
        self._scores.clear()
        self.cost, self.jerked = priors.add(self.normal, a, b)
        for factor, rows in self._rows.items():
            if factor not in self._batches:
                self._batches[factor] = factor.stack(np.array(self._times[factor]), rows)
            report = factor.linearise(self._batches[factor], a, b, self.normal)
            self.reports[factor] = report
            self.cost += report.cost
        self.changed = False

    def batch(self, factor: Factor) -> tuple | None:
        """Arrays of one factor's rows, where they were linearised."""
        return self._batches.get(factor)

    def share_of(self, factor: Factor, a: Column, b: Column, sensor: str = '') -> Normal:
        """Give what a factor, or one of its sensors, adds to the equations at columns a and b."""
        share, weights = Normal.zeros(len(self.normal.g)), factor.weights
        if factor in self._batches:
            if sensor:
                factor.weights = weights * [name == sensor for name in factor.sensors]
            factor.linearise(self._batches[factor], a, b, share)
            factor.weights = weights
        return share

    def clock_scores(self, factor: Factor, a: Column, b: Column) -> ClockScores | None:
        """How the factor's measurements here would change with their sensors' clocks."""
        if factor in self._batches and factor not in self._scores:
            self._scores[factor] = factor.clock_scores(self._batches[factor], a, b)
        return self._scores.get(factor)

    def bordered(self, priors: Priors, a: Column, b: Column, of: Parameters) -> Border:
        """Say what priors and measurements tell of the constants `of` the robot, linearised."""
        dim = len(self.normal.g) // 2
        border = Border.zeros(2 * dim, of.size)
        newer = Border(border.C[dim:], border.H, border.g)
        priors.bordered(newer, b, priors.share(b.time - a.time), of)
        for factor, batch in self._batches.items():
            factor.bordered(batch, a, b, border, of)
        border.level(of.clocks)
        return border

    def modelled_cost(self, offset_a: np.ndarray, offset_b: np.ndarray) -> float:
        """Cost that the quadratic model gives at offsets from the linearisation point."""
        x = np.concatenate([offset_a, offset_b])
        return self.cost + float(self.normal.g @ x) + self.normal.half_square(x)
