"""
What would explain the measurements: the newest stretch once more, with one thing otherwise.

When the window does not fit, somebody is wrong, and who is not told by who fits worst: a sensor
of great weight pulls the body to itself, and its neighbours off. So the newest measurements are
solved once more in a window of their own, from the prior alone, with one thing otherwise: without
a sensor, with its zones in another order, with a free base. What makes all the others fit far
better is the explanation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from continuum_loc.errors import SingularError
from continuum_loc.estimator.factors import FACTORS, Setup
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.solver import from_a_guess
from continuum_loc.estimator.window import Window
from continuum_loc.measurements import (
    EncoderSample,
    Measurement,
    seconds,
    StrainSample,
    TofFrame,
    TrackedPose,
)
from continuum_loc.robot import RobotDescription
import numpy as np

BASE_FREED = 1e3  # times its standard deviations
# Share of the cost that an explanation has to take away. Every real robot departs a little from
# its description, and whatever is left out then makes the rest fit better.
GAIN = 0.5
# An encoder is one number, which the body absorbs: so little, if the base moves so far.
ENCODER_GAIN, ENCODER_MOVE = 0.12, 0.01  # share, m
RUNNER_UP = 2.0  # times as much as the next best
MOST_ITERATIONS = 12  # of a trial: what has not come by then is no explanation
DECISIVE = 0.6  # share of the cost beyond which no other explanation is asked for


@dataclass(frozen=True, slots=True)
class Explanation:
    """
    One thing that may be otherwise than described.

    sensors: whom it accuses; cause: in words. change: what a measurement would be, None where it
    would not be used. kind: the factor whose measurements it takes away, not to be counted on
    either side. base_freed: the description's base is not believed. gain, move: what it has to
    bring to be believed.
    """

    sensors: tuple[str, ...]
    cause: str
    change: Callable[[Measurement], Measurement | None]
    kind: str = ''
    base_freed: bool = False
    gain: float = GAIN
    move: float = 0.0  # [m] that the base has to move by


class Outcome(NamedTuple):
    """Robust cost of the measurements by factor, and the window that they were solved in."""

    costs: dict[str, float]
    window: Window

    def without(self, kind: str) -> float:
        """Cost of all factors but one."""
        return sum(cost for name, cost in self.costs.items() if name != kind)


class Stretch:
    """The newest measurements of a window, to be solved again."""

    def __init__(
        self,
        setup: Setup,
        window: Window,
        epoch: int,
        measurements: Sequence[Measurement],
        newest: int,
    ):
        self._setup, self._epoch = setup, epoch
        solver = setup.settings.solver
        least = min(MOST_ITERATIONS, solver.acquisition_iterations)
        hurried = solver.model_copy(update={'acquisition_iterations': least})
        self._hurried = setup.settings.model_copy(update={'solver': hurried})
        count = len(window.columns)
        self._columns = [window.column(k) for k in range(max(count - newest - 1, 0), count)]
        first, last = self._columns[0].time, self._columns[-1].time
        self._measurements = [
            one for one in measurements if first < seconds(one.stamp, epoch) <= last
        ]

    def solve(self, explanation: Explanation) -> Outcome | None:
        """Solve with one thing otherwise; None where nothing is left, or no solution."""
        setup, columns = self._setup, self._columns
        robot = base_freed(setup.robot) if explanation.base_freed else setup.robot
        priors = Priors(robot, setup.grid, setup.settings)
        window = Window(setup.grid, priors, self._hurried)
        window.start(columns[0])
        factors = [kind(setup) for kind in FACTORS if kind.wanted(setup)]
        for measurement in self._measurements:
            changed = explanation.change(measurement)
            if changed is not None:
                window.enter(factors, seconds(changed.stamp, self._epoch), changed)
        if not window.intervals:
            return None
        window.set_columns(columns[: len(window.columns)])
        try:
            from_a_guess(window, factors)
        except SingularError:
            return None
        costs: dict[str, float] = {}
        for interval in window.intervals:
            for factor, report in interval.reports.items():
                costs[factor.name] = costs.get(factor.name, 0.0) + report.cost
        return Outcome(costs, window)


def base_freed(robot: RobotDescription) -> RobotDescription:
    """Make of a robot one of whose base next to nothing is known."""
    base = robot.base
    loose = {
        'sigma_position': BASE_FREED * base.sigma_position,
        'sigma_rotation_deg': min(BASE_FREED * base.sigma_rotation_deg, 90.0),
    }
    return robot.model_copy(update={'base': base.model_copy(update=loose)})


AS_IS = Explanation((), '', lambda measurement: measurement)


def explanations(robot: RobotDescription, used: set[str]) -> list[Explanation]:
    """Everything that may be otherwise; `used` are the names of the factors that there are."""
    found: list[Explanation] = []
    if 'tof' in used:
        found += _of_tof(robot)
    if 'insertion' in used and robot.base.insertion.mode == 'measured':
        encoder = _without(EncoderSample, 'insertion', 'contradicts the rest', 'insertion')
        found.append(replace(encoder, gain=ENCODER_GAIN, move=ENCODER_MOVE))
    found.append(
        Explanation(
            ('base',), 'is not where the description has it', AS_IS.change, base_freed=True
        )
    )
    if 'strain' in used and robot.strain is not None:
        found.append(_without(StrainSample, 'strain', 'contradicts the rest', 'strain'))
    if 'tracker' in used and len(robot.trackers) > 1:
        found += [
            _without(TrackedPose, one.name, 'contradicts the rest', 'tracker')
            for one in robot.trackers
        ]
    return found


def _without(kind: type, name: str, cause: str, factor: str) -> Explanation:
    def change(measurement: Measurement) -> Measurement | None:
        mine = isinstance(measurement, kind) and getattr(measurement, 'sensor', name) == name
        return None if mine else measurement

    return Explanation((name,), cause, change, factor)


def _of_tof(robot: RobotDescription) -> list[Explanation]:
    """Ways in which all ToF frames may be meant otherwise."""
    model = robot.tof_model
    zones = np.arange(model.rows * model.columns).reshape(model.rows, model.columns)
    cosine, names = model.directions[:, 0], tuple(sensor.name for sensor in robot.tof)

    def of(zone: np.ndarray, scale: np.ndarray | float, cause: str) -> Explanation:
        def change(measurement: Measurement) -> Measurement:
            if not isinstance(measurement, TofFrame) or len(measurement.ranges) != zones.size:
                return measurement
            ranges = measurement.ranges[zone] * scale
            finite = np.isfinite(ranges)[:, None]
            return replace(
                measurement,
                ranges=ranges,
                points=np.where(
                    finite, np.where(finite, ranges[:, None], 0.0) * model.directions, np.nan
                ),
                sigma=measurement.sigma[zone],
                status=measurement.status[zone],
            )

        return Explanation(names, cause, change)

    same = zones.ravel()
    found = [
        of(same, 1.0 / cosine, 'perpendicular distances taken for ranges?'),
        of(same, cosine, 'ranges taken for perpendicular distances?'),
        of(zones[::-1].ravel(), 1.0, 'rows of zones the other way round?'),
        of(zones[:, ::-1].ravel(), 1.0, 'columns of zones the other way round?'),
        of(zones[::-1, ::-1].ravel(), 1.0, 'rows and columns of zones the other way round?'),
    ]
    if model.rows == model.columns:
        found.append(of(zones.T.ravel(), 1.0, 'rows of zones taken for columns?'))
    return found


@dataclass(slots=True)
class Round:
    """One explanation after another, and what each takes away of the cost."""

    stretch: Stretch
    left: list[Explanation]
    as_is: Outcome
    gains: list[tuple[float, Explanation, Outcome]]

    @classmethod
    def of(cls, stretch: Stretch, candidates: list[Explanation]) -> Round | None:
        """Begin with the stretch as it is; None where it cannot be solved."""
        as_is = stretch.solve(AS_IS)
        return None if as_is is None else cls(stretch, list(candidates), as_is, [])

    def step(self) -> bool:
        """Try the next; True once no more has to be tried."""
        explanation = self.left.pop(0)
        outcome = self.stretch.solve(explanation)
        if outcome is not None:
            before = self.as_is.without(explanation.kind)
            gain = (before - outcome.without(explanation.kind)) / max(before, 1e-9)
            self.gains.append((gain, explanation, outcome))
            if gain > DECISIVE:
                return True
        return not self.left

    def verdict(self) -> Explanation | None:
        """Choose the explanation that clearly takes away most; None where there is none."""
        ranked = sorted(self.gains, key=_gain, reverse=True)
        if not ranked or not self._enough(*ranked[0]):
            return None
        best, explanation, _ = ranked[0]
        # Of one sensor or all of its kind, the one that does nearly as much is the better word.
        for gain, other, _ in ranked[1:]:
            if set(other.sensors) < set(explanation.sensors) and gain > 0.5 * best:
                best, explanation = gain, other
        rivals = [
            gain for gain, other, _ in ranked if not set(other.sensors) & set(explanation.sensors)
        ]
        if rivals and max(rivals) * RUNNER_UP > best:
            return None
        return explanation

    def _enough(self, gain: float, explanation: Explanation, outcome: Outcome) -> bool:
        """Whether an explanation brings what it has to."""
        before, after = (one.window.column(-1).T[0, :3, 3] for one in (self.as_is, outcome))
        moved = float(np.linalg.norm(after - before))
        return gain >= explanation.gain and moved >= explanation.move


def _gain(one: tuple[float, Explanation, Outcome]) -> float:
    return one[0]
