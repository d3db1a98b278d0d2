"""
One recording as a whole: the window of the filter without an end, to be solved with the robot.

The filter runs over it once, for a start. From then on its columns are kept, and everything is
read and linearised anew whenever the robot has turned out to be another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from continuum_loc.corrections import Corrections
from continuum_loc.errors import CalibrationError
from continuum_loc.estimator.factors import FACTORS, Setup
from continuum_loc.estimator.filter import SlidingWindowFilter
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.smoother import ENDLESS
from continuum_loc.estimator.state import Column, Grid
from continuum_loc.estimator.window import Window
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import Measurement, seconds
from continuum_loc.robot import RobotDescription
import numpy as np

LEAST_COLUMNS = 10


class Recording:
    """Measurements of one recording, and the body's columns through it."""

    def __init__(self, measurements: Sequence[Measurement]):
        self.measurements = list(measurements)
        self.columns: list[Column] = []
        self._epoch = 0
        self._window: Window | None = None

    def start(
        self,
        robot: RobotDescription,
        prior_map: PriorMap | None,
        settings: EstimatorSettings,
        progress: Callable[[float], None] = lambda elapsed: None,
    ) -> None:
        """
        Run the filter, and keep its columns as smooth as the window has them.

        progress: told the time [s]. Raises CalibrationError where there is too little.
        """
        filter_ = SlidingWindowFilter(robot, prior_map, settings)
        kept: dict[int, Column] = {}
        for measurement in self.measurements:
            if filter_.process(measurement) is None:
                continue
            for k, column in enumerate(filter_.window.columns):
                kept[round(column.time / settings.knot_period)] = filter_.window.column(k)
            progress(seconds(filter_.newest, filter_.epoch))
        self.columns = [kept[number] for number in sorted(kept)]
        if len(self.columns) < LEAST_COLUMNS:
            raise CalibrationError(
                f'a recording gave the body at {len(self.columns)} knots; a calibration needs '
                f'{LEAST_COLUMNS} or more, which is {LEAST_COLUMNS * settings.knot_period:g} s'
            )
        self._epoch = filter_.epoch

    def read(
        self, robot: RobotDescription, prior_map: PriorMap | None, settings: EstimatorSettings
    ) -> float:
        """Linearise at the columns all that a robot so described has measured; the cost."""
        settings = settings.model_copy(update={'window': ENDLESS})
        setup = Setup(robot, Grid(robot, settings.node_spacing), settings, prior_map)
        window = Window(setup.grid, Priors(robot, setup.grid, settings), settings)
        window.start(self.columns[0])
        factors = [kind(setup) for kind in FACTORS if kind.wanted(setup)]
        corrections = Corrections(robot)
        first, last = self.columns[0].time, self.columns[-1].time
        for measurement in self.measurements:
            measurement = corrections.applied(measurement)
            time = seconds(measurement.stamp, self._epoch)
            if first < time <= last:
                window.enter(factors, time, measurement)
        window.set_columns(self.columns[: len(window.columns)])
        for k, interval in enumerate(window.intervals):
            interval.linearise(window.priors, window.columns[k], window.columns[k + 1])
        self._window = window
        return sum(interval.cost for interval in window.intervals)

    def eliminate(self, of: Parameters) -> tuple[np.ndarray, np.ndarray]:
        """Eliminate the columns: information (P, P) and gradient (P,) of the constants."""
        window = self._window
        self._offsets = window.chain.solve([one.normal for one in window.intervals], 0)
        C, H, g = window.border(of)
        self._Z = window.chain.whiten(C)
        H = H - sum(z.T @ z for z in self._Z)
        return H, g + np.einsum('kdp,kd->p', C, np.array(self._offsets))

    def move(self, step: np.ndarray) -> float:
        """Move the columns by their own step and that of the constants (P,); the largest move."""
        pull = self._window.chain.unwhiten([z @ step[:, None] for z in self._Z])
        moves = [x - p[:, 0] for x, p in zip(self._offsets, pull, strict=True)]
        columns = self._window.columns
        self.columns = [one.retract(move) for one, move in zip(columns, moves, strict=True)]
        return float(max(np.abs(move).max() for move in moves))
