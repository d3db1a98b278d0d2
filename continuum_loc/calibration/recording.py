"""
One recording as a whole: the window of the filter without an end, to be solved with the robot.

The filter runs over it once, for a start; from then on the columns are kept, and everything is
read and linearised anew whenever the description of the robot has changed.
"""

from __future__ import annotations

from collections.abc import Sequence

from continuum_loc.corrections import Corrections
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator.border import Border
from continuum_loc.estimator.factors import FACTORS, Setup
from continuum_loc.estimator.filter import SlidingWindowFilter
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.smoother import ENDLESS
from continuum_loc.estimator.state import Column
from continuum_loc.estimator.window import Window
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import Measurement, seconds
from continuum_loc.robot import RobotDescription
import numpy as np


class Recording:
    """Measurements of one recording, and the body's columns through it."""

    def __init__(self, measurements: Sequence[Measurement]):
        self.measurements = list(measurements)
        self.columns: list[Column] = []
        self.epoch = 0
        self.window: Window | None = None

    def start(
        self, robot: RobotDescription, prior_map: PriorMap | None, settings: EstimatorSettings
    ) -> None:
        """Run the filter, and keep its smoothest columns."""
        filter_ = SlidingWindowFilter(robot, prior_map, settings)
        kept: dict[int, Column] = {}
        for measurement in self.measurements:
            if filter_.process(measurement) is not None:
                for k in range(len(filter_.window.columns)):
                    kept[round(filter_.window.columns[k].time / settings.knot_period)] = (
                        filter_.window.column(k)
                    )
        self.epoch = filter_.epoch
        self.columns = [kept[number] for number in sorted(kept)]

    def read(
        self, robot: RobotDescription, prior_map: PriorMap | None, settings: EstimatorSettings
    ) -> None:
        """Make the window of all measurements, as a robot so described has them."""
        settings = settings.model_copy(update={'window': ENDLESS})
        setup = Setup(robot, self._grid(robot, settings), settings, prior_map)
        window = Window(setup.grid, Priors(robot, setup.grid, settings), settings)
        window.start(self.columns[0])
        factors = [kind(setup) for kind in FACTORS if kind.wanted(setup)]
        corrections = Corrections(robot)
        first, last = self.columns[0].time, self.columns[-1].time
        for measurement in self.measurements:
            measurement = corrections.applied(measurement)
            time = seconds(measurement.stamp, self.epoch)
            if first < time <= last:
                _enter(window, factors, time, measurement)
        window.set_columns(self.columns[: len(window.columns)])
        self.window = window

    def _grid(self, robot, settings):
        from continuum_loc.estimator.state import Grid

        return Grid(robot, settings.node_spacing)

    def linearise(self) -> float:
        """Linearise all intervals at the columns; the robust cost."""
        window, cost = self.window, 0.0
        for k, interval in enumerate(window.intervals):
            interval.linearise(window.priors, window.columns[k], window.columns[k + 1])
            cost += interval.cost
        return cost

    def eliminate(self, of: Parameters) -> tuple[np.ndarray, np.ndarray]:
        """Eliminate the columns: information (P, P) and gradient (P,) of the constants."""
        window = self.window
        columns, dim = window.columns, window.grid.dim
        self._offsets = window.chain.solve([one.normal for one in window.intervals], 0)
        C = np.zeros((len(columns), dim, of.size))
        start = Border.zeros(dim, of.size)
        window.priors.bordered(start, columns[0], 1.0, of)
        C[0], H, g = start
        for k, interval in enumerate(window.intervals):
            border = interval.bordered(window.priors, columns[k], columns[k + 1], of)
            C[k] += border.C[:dim]
            C[k + 1] += border.C[dim:]
            H += border.H
            g += border.g
        self._C = C
        self.Z = window.chain.whiten(C)
        H = H - sum(z.T @ z for z in self.Z)
        g = g + sum(c.T @ x for c, x in zip(C, self._offsets, strict=True))
        return H, g

    def move(self, step: np.ndarray) -> float:
        """Move the columns by their own step and that of the constants (P,); the largest move."""
        window = self.window
        pull = window.chain.unwhiten([z @ step[:, None] for z in self.Z])
        moves = [x - p[:, 0] for x, p in zip(self._offsets, pull, strict=True)]
        self.columns = [one.retract(move) for one, move in zip(window.columns, moves, strict=True)]
        return float(max(np.abs(move).max() for move in moves))


def _enter(window: Window, factors: list, time: float, measurement: Measurement) -> None:
    for factor in factors:
        if isinstance(measurement, factor.consumes):
            try:
                row = factor.row(measurement)
            except MeasurementError:
                continue
            window.interval_at(time).add(factor, time, row)
