"""
The contract that every sensor's factor keeps.

A factor turns a measurement into a *row* when it arrives (a named tuple, in the body frame of its
node), stacks the rows of an interval into a *batch* of arrays once, and adds their normal
equations to the interval's each time that it is linearised. It owns what it remembers of its
sensors; what others decide (whom to believe, how widely to match) comes in by `weigh` and
`loosen`. A new sensor is one file beside this one and an entry in FACTORS.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.border import Border
from continuum_loc.estimator.matching import Surface, surface_of
from continuum_loc.estimator.normal import Normal
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import Column, Grid
from continuum_loc.mapping.distances import DistanceField
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.robot import RobotDescription
import numpy as np


@dataclass(eq=False)
class Setup:
    """What factors are made from; the map's surface and distances are made once, when asked."""

    robot: RobotDescription
    grid: Grid
    settings: EstimatorSettings
    prior_map: PriorMap | None = None

    @cached_property
    def distances(self) -> DistanceField:
        return DistanceField.of(self.prior_map)

    @cached_property
    def surface(self) -> Surface:
        return surface_of(self.prior_map, self.settings.tof.planarity_power)


class FactorReport(NamedTuple):
    """
    How an interval's measurements of one kind fit.

    Robust cost, sum of squared normalised residuals and their number. Of the factor's S sensors,
    where it tells: fits (S, 2), their usable and fitting samples; rattle (S, 3), the variance of
    the turns that the motion between the knots does not follow [rad^2], nan where there was no
    sample; flicker (S, 2), zones seen in two frames in a row and those of them that the map
    matched in just one.
    """

    cost: float
    squared: float
    count: int
    fits: np.ndarray | None = None
    rattle: np.ndarray | None = None
    flicker: np.ndarray | None = None


class ClockScores(NamedTuple):
    """
    How an interval's cost depends on what a factor's S sensors may be off by, to second order.

    Of each sensor's n unknowns the clock comes first, then its `Factor.tolerances`. gradient
    (S, n), information (S, n, n); coupling (2 D, S, n) with the offsets of the interval's two
    columns; spread: (S,) variance of the residuals that no offset explains over that of the noise.
    """

    gradient: np.ndarray
    information: np.ndarray
    coupling: np.ndarray
    spread: np.ndarray

    @classmethod
    def zeros(cls, sensors: int, unknowns: int, dim: int) -> ClockScores:
        return cls(
            np.zeros((sensors, unknowns)),
            np.zeros((sensors, unknowns, unknowns)),
            np.zeros((2 * dim, sensors, unknowns)),
            np.zeros(sensors),
        )


@dataclass(slots=True)
class Guess:
    """Base (4, 4), strain (N, 6) and frames (F, 4, 4) from which the first solve starts."""

    T_map_base: np.ndarray
    strain: np.ndarray
    T_map_frame: np.ndarray


class Factor(ABC):
    """
    One kind of sensor on one robot.

    sensors: names of those that may be suspect, in the order of reports and scores. weights: (S,)
    how much each counts.
    """

    name: ClassVar[str]
    consumes: type | tuple[type, ...]
    batch: ClassVar[type]  # named tuple of times and of what a row has, with a number in front
    rate: float = 0.0  # [Hz] of its sensors, where these set the pace of the estimates
    # What a sensor may be off by besides its clock, 1 sigma each, in the order of `clock_scores`.
    tolerances: ClassVar[np.ndarray] = np.empty(0)
    tight: bool = True  # whether it matches as narrowly as while tracking

    def __init__(self, setup: Setup, sensors: Collection[str] = ()):
        self.robot, self.grid, self.settings = setup.robot, setup.grid, setup.settings
        self.sensors, self.weights = tuple(sensors), np.ones(len(sensors))
        self._work = gp.new_workspace()

    @classmethod
    def wanted(cls, setup: Setup) -> bool:
        """Whether a filter of this setup has such a factor: unless its settings switch it off."""
        return getattr(getattr(setup.settings, cls.name, None), 'enabled', True)

    def describe(self, robot: RobotDescription) -> None:
        """Read measurements as those of a robot with other constants (`parameters`)."""
        self.robot = robot

    @abstractmethod
    def row(self, measurement: Any) -> tuple:
        """
        Return the measurement in the body frame of its node.

        Raises MeasurementError where it cannot be used.
        """

    def stack(self, times: np.ndarray, rows: list[tuple]) -> tuple:
        """Arrays of all rows of an interval; `times` (M,) seconds from the interval's start."""
        return self.batch(times, *(np.array(column) for column in zip(*rows, strict=True)))

    @abstractmethod
    def linearise(self, batch: tuple, a: Column, b: Column, normal: Normal) -> FactorReport:
        """Add the normal equations of `batch` between the columns a and b."""

    def clock_scores(self, batch: tuple, a: Column, b: Column) -> ClockScores | None:
        """Say how the cost depends on the sensors' clocks; None where that is not asked for."""
        return None

    def bordered(self, batch: tuple, a: Column, b: Column, border: Border, of: Parameters) -> None:  # noqa: B027
        """Add what the measurements say of the constants `of` the robot to their border."""

    def awaited(self) -> bool:
        """Whether the first guess of the body is a poor one without this kind of sample."""
        return False

    def needed(self) -> type | None:
        """Say which kind of sample the filter cannot begin without."""
        return None

    def lateness(self, measurement: Any) -> float:
        """By how much a measurement's stamp is later than what it tells of [s]."""
        return 0.0

    def guess(self, row: tuple, guess: Guess) -> None:  # noqa: B027
        """Put what a row tells of base and shape into the first guess."""

    def weigh(self, doubted: Collection[str], weight: float) -> bool:
        """Have the sensors in `doubted` count by `weight`, others fully; True if that is new."""
        before = self.weights
        self.weights = np.array([weight if name in doubted else 1.0 for name in self.sensors])
        return not np.array_equal(before, self.weights)

    def use_map(self, setup: Setup, rows: list[tuple]) -> None:  # noqa: B027
        """Match to the map of `setup` from now on, and what is in these rows anew."""

    def loosen(self, iteration: int) -> bool:
        """
        Match as widely as befits an iteration (1, 2, ...) from a guess, 0 as while tracking.

        True if what is matched has to be matched anew.
        """
        return False


class Repeats:
    """Tells a frozen sensor: the same to the last bit more than `most` times in a row."""

    def __init__(self, most: int):
        self._most = most
        self._last: dict[str, bytes] = {}
        self._count: dict[str, int] = {}

    def frozen(self, sensor: str, values: np.ndarray) -> bool:
        """Note a sample; True when the sensor has repeated itself too often."""
        data = np.ascontiguousarray(values).tobytes()
        again = self._last.get(sensor) == data
        self._count[sensor] = self._count.get(sensor, 0) + 1 if again else 0
        self._last[sensor] = data
        return self._count[sensor] > self._most


def require_finite(values: np.ndarray, what: str, sensor: str) -> None:
    """Raise MeasurementError unless every value is finite."""
    if not np.isfinite(values).all():
        raise MeasurementError(
            'not finite', f"{what} of '{sensor}' is not finite: {np.asarray(values).tolist()}"
        )


def known_sensor(sensors: dict[str, Any], name: str, kind: str) -> Any:
    """Return the entry of `name`, or raise MeasurementError listing the valid names."""
    try:
        return sensors[name]
    except KeyError:
        raise MeasurementError(
            'unknown frame',
            f"{kind} frame '{name}' is not in the robot description; valid: {', '.join(sensors)}",
        ) from None
