"""Named trajectories: tendon tensions and insertion as smooth functions of time.

Each begins with one second at rest (the settled shape under the first row's tensions), which the estimator may
use to average gyro biases; its first keyframe ends that rest. Between keyframes a cubic spline keeps tensions and
their rates continuous.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline

from continuum_loc.robot import RobotDescription
from continuum_loc.settings import SettingsError
from continuum_loc.simulator.plant import PlantSettings

REST = 1.0  # seconds at rest at the start
GRAVITY = 9.81


@dataclass(frozen=True, slots=True)
class Command:
    """What the drives are told: tensions (K,) N, insertion m, insertion rate m/s."""

    tension: np.ndarray
    insertion: float
    insertion_rate: float


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Keyframes: times (M,) s, tensions (M, K) N, insertion (M,) m; held before the first and after the last."""

    name: str
    times: np.ndarray
    tensions: np.ndarray
    insertion: np.ndarray
    _spline: CubicSpline = field(init=False, repr=False)

    def __post_init__(self) -> None:
        values = np.column_stack([self.tensions, self.insertion])
        if len(self.times) < 2 or np.any(np.diff(self.times) <= 0.0) or not np.all(np.isfinite(values)):
            raise ValueError(f"trajectory '{self.name}': needs two or more finite keyframes at increasing times")
        object.__setattr__(self, "_spline", CubicSpline(self.times, values, bc_type="clamped"))

    @property
    def duration(self) -> float:
        """Time of the last keyframe [s]."""
        return float(self.times[-1])

    def command(self, time: float) -> Command:
        """The command at `time` [s]; tensions never below zero."""
        t = min(max(time, self.times[0]), self.times[-1])
        value, rate = self._spline(t), self._spline(t, 1)
        return Command(np.maximum(value[:-1], 0.0), float(value[-1]), float(rate[-1]) if t == time else 0.0)


# Keyframes of the engine robot: time [s], insertion [m], then for each module the curvature wanted about body y
# (positive lowers the tip) and body z (positive to the left) [1/m], beyond what holds the robot level.
_ENGINE = {
    # Straight in through the fans' gap, looking about on the way: slow and wide.
    "t1": [
        (1.0, 0.00, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        (4.0, 0.12, (0.1, 0.1), (-0.2, 0.2), (-0.3, 0.4)),
        (7.0, 0.24, (0.1, -0.1), (-0.2, -0.3), (0.3, -0.8)),
        (10.0, 0.34, (-0.1, 0.1), (0.3, 0.3), (0.6, 0.6)),
        (13.0, 0.44, (0.0, 0.1), (0.2, 0.2), (-0.5, 0.9)),
        (16.0, 0.48, (0.1, -0.1), (-0.2, -0.3), (-0.3, -0.9)),
        (18.5, 0.44, (0.0, 0.0), (0.2, 0.1), (0.6, 0.2)),
        (20.0, 0.42, (0.0, 0.0), (0.0, 0.0), (0.2, 0.0)),
    ],
    # Brisk: the tip sweeps within a second, stops, and sweeps back, between short pushes of the insertion.
    "t2": [
        (1.0, 0.10, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        (2.4, 0.14, (0.0, 0.1), (-0.1, 0.1), (-0.3, 0.3)),
        (3.2, 0.16, (0.0, 0.1), (-0.1, 0.1), (-0.3, 0.3)),
        (4.6, 0.20, (0.1, -0.1), (0.1, -0.1), (0.4, -0.4)),
        (5.4, 0.22, (0.1, -0.1), (0.1, -0.1), (0.4, -0.4)),
        (6.8, 0.30, (-0.1, 0.0), (-0.2, 0.0), (-0.6, 0.1)),
        (8.2, 0.34, (0.1, 0.0), (0.2, 0.1), (0.7, 0.1)),
        (9.8, 0.36, (0.1, 0.1), (0.0, 0.2), (0.1, 0.6)),
        (11.2, 0.30, (-0.1, 0.0), (-0.2, 0.0), (-0.6, -0.3)),
        (12.6, 0.28, (0.0, -0.1), (0.2, -0.1), (0.6, -0.5)),
        (13.4, 0.28, (0.0, -0.1), (0.2, -0.1), (0.6, -0.5)),
        (14.8, 0.36, (0.1, 0.1), (-0.1, 0.1), (-0.6, 0.4)),
        (16.2, 0.44, (0.0, 0.0), (0.2, 0.0), (0.7, -0.1)),
        (17.4, 0.40, (0.0, 0.0), (-0.1, 0.0), (-0.3, 0.2)),
        (19.2, 0.30, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        (20.0, 0.30, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    ],
    # Deep: to the end of the travel, leaning on the blades and sliding along them.
    "t3": [
        (1.0, 0.05, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        (4.0, 0.20, (-0.1, 0.2), (-0.2, 0.4), (-0.4, 0.4)),
        (6.5, 0.34, (-0.1, 0.3), (-0.1, 0.6), (0.2, 1.0)),
        (9.0, 0.46, (0.1, 0.0), (0.2, 0.3), (0.8, 0.8)),
        (11.0, 0.52, (0.1, -0.2), (0.3, -0.4), (0.9, -0.6)),
        (13.0, 0.56, (0.1, -0.4), (0.0, -0.8), (-0.4, -1.3)),
        (15.0, 0.58, (-0.1, -0.2), (-0.4, -0.4), (-0.9, -0.6)),
        (17.0, 0.55, (-0.1, 0.2), (-0.2, 0.3), (0.4, 0.9)),
        (18.5, 0.50, (0.0, 0.2), (0.2, 0.3), (0.8, 0.5)),
        (20.0, 0.46, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
    ],
}


def trajectory(name: str, robot: RobotDescription, plant: PlantSettings, seed: int = 0) -> Trajectory:
    """The named trajectory of this robot. A seed other than 0 varies every keyframe after the rest by some percent."""
    tables = TRAJECTORIES.get(robot.name, {})
    if name not in tables:
        raise SettingsError(f"robot '{robot.name}' has no trajectory '{name}'; "
                            f"trajectories: {', '.join(tables) or 'none (give a Trajectory of your own)'}")
    made = tables[name](name, robot, plant)
    return made if seed == 0 else _varied(made, np.random.default_rng(seed))


def trajectory_names(robot: RobotDescription) -> tuple[str, ...]:
    """Trajectories known for this robot."""
    return tuple(TRAJECTORIES.get(robot.name, {}))


def _engine(name: str, robot: RobotDescription, plant: PlantSettings) -> Trajectory:
    rows = _ENGINE[name]
    curvature = np.array([row[2:] for row in rows])  # (M, modules, 2)
    moments = plant.EI * curvature + _level_moments(robot, plant)
    return Trajectory(name, np.array([row[0] for row in rows]), plant.tension_for_moments(moments),
                      np.array([row[1] for row in rows]))


def _level_moments(robot: RobotDescription, plant: PlantSettings) -> np.ndarray:
    """(G, 2) bending moments, constant in each module, whose mean holds a level rod against its own weight.

    A cantilever's moment is w (L - s)^2 / 2; the mean over [a, b] is w ((L - a)^3 - (L - b)^3) / (6 (b - a)).
    """
    ends = np.array([group.end for group in plant.tendons])
    starts = np.concatenate([[0.0], ends[:-1]])
    left = robot.length - np.stack([starts, ends])
    mean = plant.mass_per_metre * GRAVITY * (left[0]**3 - left[1]**3) / (6.0 * (ends - starts))
    return np.stack([-mean, np.zeros_like(mean)], axis=-1)


def _varied(base: Trajectory, rng: np.random.Generator) -> Trajectory:
    moving = base.times > REST
    scale = 1.0 + 0.05 * rng.standard_normal((len(base.times), 1)) * moving[:, None]
    insertion = np.clip(base.insertion * (1.0 + 0.03 * rng.standard_normal(len(base.times)) * moving), 0.0, None)
    return Trajectory(base.name, base.times, base.tensions * scale, insertion)


TRAJECTORIES = {"engine": {name: _engine for name in _ENGINE}}
