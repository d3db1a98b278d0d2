"""
Contract that every sensor's factor keeps.

A new sensor is one file beside this one and an entry in FACTORS.

A factor turns a measurement into a *row* when it arrives (a tuple of floats and arrays, in the
body frame of its node), stacks the rows of an interval into arrays once, and adds their normal
equations to the interval's blocks each time that the interval is linearised.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar

from continuum_loc.errors import MeasurementError
from continuum_loc.estimator.chain import Blocks
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import Column, Grid
from continuum_loc.robot import RobotDescription
import numpy as np


@dataclass(slots=True)
class FactorReport:
    """
    How an interval's measurements of one kind fit.

    Robust cost, sum of squared normalised residuals and their number, for each sensor its
    [usable, fitting] counts, and for each gyro the variance (3,) of the turns that the motion
    between the knots does not follow [rad^2]. `flicker` counts for each ToF sensor zones seen in
    two frames in a row, and those of them that the map matched in just one.
    """

    cost: float = 0.0
    squared: float = 0.0
    count: int = 0
    fits: dict[str, np.ndarray] = field(default_factory=dict)
    rattle: dict[str, np.ndarray] = field(default_factory=dict)
    flicker: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ClockScores:
    """
    How an interval's cost depends on its S sensors' clocks, to second order.

    gradient, information: (S,); coupling (2 D, S) with the offsets of the interval's two columns;
    spread: (S,) variance of the residuals that no offset explains over that of the noise.
    """

    sensors: list[str]
    gradient: np.ndarray
    information: np.ndarray
    coupling: np.ndarray
    spread: np.ndarray


class Factor(ABC):
    """One kind of sensor on one robot."""

    name: ClassVar[str]
    consumes: ClassVar[type]

    def __init__(self, robot: RobotDescription, grid: Grid, settings: EstimatorSettings):
        self.robot, self.grid, self.settings = robot, grid, settings
        self.weights: dict[str, float] = {}  # of sensors that may become suspect

    @abstractmethod
    def row(self, measurement: Any) -> tuple:
        """
        Return the measurement in the body frame of its node.

        Raises MeasurementError where it cannot be used.
        """

    @abstractmethod
    def stack(self, times: np.ndarray, rows: list[tuple]) -> tuple:
        """Arrays of all rows of an interval; `times` (M,) seconds from the interval's start."""

    @abstractmethod
    def linearise(self, batch: tuple, a: Column, b: Column, blocks: Blocks) -> FactorReport:
        """Add the normal equations of `batch` between the columns a and b."""

    def clock_scores(self, batch: tuple, a: Column, b: Column) -> ClockScores | None:
        """Say how the cost depends on the sensors' clocks; None where that is not asked for."""
        return None


class Repeats:
    """
    Tells a frozen sensor.

    Frozen: its samples are the same to the last bit more than `most` times in a row.
    """

    def __init__(self, most: int):
        self._most = most
        self._last: dict[str, bytes] = {}
        self._count: dict[str, int] = {}

    def frozen(self, sensor: str, values: np.ndarray) -> bool:
        """Note a sample; True when the sensor has repeated itself too often."""
        data = np.ascontiguousarray(values).tobytes()
        self._count[sensor] = (
            self._count.get(sensor, 0) + 1 if self._last.get(sensor) == data else 0
        )
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
