"""
Named trajectories: tendon tensions and insertion as smooth functions of time.

Each begins with one second at rest (the settled shape under the first row's tensions), which the
estimator may use to average gyro biases; its first keyframe ends that rest. Between keyframes a
monotone cubic keeps values and
rates continuous and never overshoots a keyframe: no tension is commanded that the table does not
show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from continuum_loc.errors import SettingsError
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import load_settings, Settings
from continuum_loc.simulator.plant import PlantSettings
import numpy as np
from pydantic import Field
from scipy.interpolate import PchipInterpolator

REST = 1.0  # seconds at rest at the start
GRAVITY = 9.81
LEVELLED = 0.25  # [s] between keyframes of a trajectory that follows a rolled base


@dataclass(frozen=True, slots=True)
class Command:
    """What the drives are told: tensions (K,) N, insertion m, insertion rate m/s."""

    tension: np.ndarray
    insertion: float
    insertion_rate: float


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """
    Keyframes: times (M,) s, tensions (M, K) N, insertion (M,) m; the first and last are held.

    supported: the arm lies in a groove that carries its weight.
    """

    name: str
    times: np.ndarray
    tensions: np.ndarray
    insertion: np.ndarray
    supported: bool = False
    _spline: PchipInterpolator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        values = np.column_stack([self.tensions, self.insertion])
        if self.tensions.min(initial=0.0) < 0.0:
            raise ValueError(
                f"trajectory '{self.name}': tendons only pull, got {self.tensions.min()} N"
            )
        if (
            len(self.times) < 2
            or np.any(np.diff(self.times) <= 0.0)
            or not np.all(np.isfinite(values))
        ):
            raise ValueError(
                f"trajectory '{self.name}': needs two or more finite keyframes at increasing times"
            )
        # One more second of the end values on either side: the motion starts and ends with zero
        # rate.
        times = np.concatenate([[self.times[0] - 1.0], self.times, [self.times[-1] + 1.0]])
        object.__setattr__(
            self, '_spline', PchipInterpolator(times, values[[0, *range(len(values)), -1]])
        )

    @property
    def duration(self) -> float:
        """Time of the last keyframe [s]."""
        return float(self.times[-1])

    def command(self, time: float) -> Command:
        """Give the command at `time` [s]."""
        t = min(max(time, self.times[0]), self.times[-1])
        value, rate = self._spline(t), self._spline(t, 1)
        return Command(value[:-1], float(value[-1]), float(rate[-1]))


# Keyframes of the engine robot: time [s], insertion [m], then for each module the curvature wanted
# about body y (positive lowers the tip) and body z (positive to the left) [1/m], beyond what holds
# the robot level.
_ENGINE = {
    # Straight in through the fans' gap, looking about on the way: slow and wide.
    't1': [
        (1.0, 0.00, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
        (4.0, 0.12, (0.1, 0.1), (-0.2, 0.2), (-0.3, 0.4)),
        (7.0, 0.24, (0.1, -0.1), (-0.2, -0.3), (0.3, -0.8)),
        (10.0, 0.34, (-0.1, 0.1), (0.3, 0.3), (0.6, 0.6)),
        (13.0, 0.44, (0.0, 0.1), (0.2, 0.2), (-0.5, 0.9)),
        (16.0, 0.48, (0.1, -0.1), (-0.2, -0.3), (-0.3, -0.9)),
        (18.5, 0.44, (0.0, 0.0), (0.2, 0.1), (0.6, 0.2)),
        (20.0, 0.42, (0.0, 0.0), (0.0, 0.0), (0.2, 0.0)),
    ],
    # Brisk: the tip sweeps within a second, stops, and sweeps back, between short pushes of the
    # insertion.
    't2': [
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
    't3': [
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


class Keyframe(Settings):
    """What the drives do at one time."""

    time: float = Field(
        ge=REST, description='seconds from the start, the first of which is at rest'
    )
    tensions: tuple[float, ...] = Field(description="of every tendon, in the plant's order [N]")
    insertion: float = Field(0.0, description='travel of the base [m]')


class TrajectoryFile(Settings):
    """A trajectory of your own, as YAML: `keyframes`, and whether the arm is `supported`."""

    keyframes: tuple[Keyframe, ...] = Field(min_length=2)
    supported: bool = False


def trajectory(name: str, robot: RobotDescription, plant: PlantSettings, seed: int = 0) -> Drive:
    """
    Find the named trajectory of this robot, or load one from a YAML file (`TrajectoryFile`).

    A seed other than 0 varies every keyframe after the rest by some percent.
    """
    if name.endswith(('.yaml', '.yml')):
        made = _from_file(name, plant)
    else:
        made = _bundled(name, robot, plant)
    return made if seed == 0 else _varied(made, np.random.default_rng(seed))


def _bundled(name: str, robot: RobotDescription, plant: PlantSettings) -> Drive:
    tables = TRAJECTORIES.get(robot.name, {})
    if name not in tables:
        raise SettingsError(
            f"robot '{robot.name}' has no trajectory '{name}'; give a .yaml file of your own"
            + (f', or one of {", ".join(tables)}' if tables else '')
        )
    return tables[name](name, robot, plant)


def _from_file(path: str, plant: PlantSettings) -> Drive:
    read = load_settings(TrajectoryFile, path)
    frames = read.keyframes
    for k, frame in enumerate(frames):
        if len(frame.tensions) != len(plant.tendon_names):
            raise SettingsError(
                f"{path}: keyframes.{k}.tensions: {len(frame.tensions)} values for the plant's "
                f'{len(plant.tendon_names)} tendons ({", ".join(plant.tendon_names)})'
            )
        _check_forces(f'{path}: keyframes.{k}.tensions', np.array(frame.tensions), plant)
    try:
        return Drive(
            Path(path).stem,
            np.array([frame.time for frame in frames]),
            np.array([frame.tensions for frame in frames]),
            np.array([frame.insertion for frame in frames]),
            read.supported,
        )
    except ValueError as error:
        raise SettingsError(f'{path}: {error}') from None


def _check_forces(where: str, tensions: np.ndarray, plant: PlantSettings) -> None:
    """Refuse what the drives would cut off without a word."""
    for name, tension, most in zip(plant.tendon_names, tensions, plant.max_forces, strict=True):
        if tension > most:
            raise SettingsError(
                f"{where}: {name} pulls {tension:g} N, the plant's max_force is {most:g} N"
            )


def trajectory_names(robot: RobotDescription) -> tuple[str, ...]:
    """Trajectories known for this robot."""
    return tuple(TRAJECTORIES.get(robot.name, {}))


def _engine(name: str, robot: RobotDescription, plant: PlantSettings) -> Drive:
    rows = _ENGINE[name]
    curvature = np.array([row[2:] for row in rows])  # (M, modules, 2)
    moments = plant.EI * curvature
    if len(plant.tendons) == moments.shape[1]:  # else refused below, with what there is
        moments = moments + _level_moments(robot, plant)
    return Drive(
        name,
        np.array([row[0] for row in rows]),
        plant.tension_for_moments(moments),
        np.array([row[1] for row in rows]),
    )


def levelled(
    name: str, robot: RobotDescription, plant: PlantSettings, roll: Callable[[float], float]
) -> Drive:
    """
    Make a trajectory of the engine robot whose base is rolled by `roll` (time [s]) [rad].

    The moments stay as they are in `map`: a robot that is held level must not sag aside because
    its base is turned about it.
    """
    if name not in _ENGINE or len(plant.tendons) != len(_ENGINE[name][0]) - 2:
        raise SettingsError(f"no trajectory '{name}' of robot '{robot.name}' for a rolled base")
    rows = _ENGINE[name]
    keys = np.array([row[0] for row in rows])
    curvature = PchipInterpolator(keys, np.array([row[2:] for row in rows]))
    times = np.arange(keys[0], keys[-1] + 1e-9, LEVELLED)
    moments = plant.EI * curvature(times) + _level_moments(robot, plant)
    angle = np.array([roll(time) for time in times])
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    y, z = moments[..., 0], moments[..., 1]
    turned = np.stack([cos * y + sin * z, cos * z - sin * y], axis=-1)
    insertion = PchipInterpolator(keys, np.array([row[1] for row in rows]))(times)
    return Drive(name, times, plant.tension_for_moments(turned), insertion)


def _level_moments(robot: RobotDescription, plant: PlantSettings) -> np.ndarray:
    """
    (G, 2) bending moments, one for each module, whose mean holds a level rod against its weight.

    A cantilever's moment is w (L - s)^2 / 2; the mean over [a, b] is w ((L - a)^3 - (L - b)^3) /
    (6 (b - a)).
    """
    ends = np.array([group.end for group in plant.tendons])
    starts = np.concatenate([[0.0], ends[:-1]])
    left = robot.length - np.stack([starts, ends])
    mean = plant.mass_per_metre * GRAVITY * (left[0] ** 3 - left[1] ** 3) / (6.0 * (ends - starts))
    return np.stack([-mean, np.zeros_like(mean)], axis=-1)


def _varied(base: Drive, rng: np.random.Generator) -> Drive:
    moving = base.times > REST
    scale = 1.0 + 0.05 * rng.standard_normal((len(base.times), 1)) * moving[:, None]
    insertion = np.clip(
        base.insertion * (1.0 + 0.03 * rng.standard_normal(len(base.times)) * moving), 0.0, None
    )
    return replace(base, tensions=base.tensions * scale, insertion=insertion)


# Keyframes of the soft arm: time [s], tension of the central tendon and of the three distal ones
# [N].
_BOX = {
    'b1': [  # slow, once round
        (1.0, 2, 3, 3, 3),
        (4.0, 2, 14, 3, 3),
        (7.0, 3, 13, 15, 2),
        (10.0, 4, 2, 16, 4),
        (13.0, 4, 2, 13, 15),
        (16.0, 2, 4, 2, 15),
        (18.5, 2, 9, 2, 6),
        (20.0, 2, 6, 3, 3),
    ],
    'b2': [  # the central tendon against the distal ones: far out on one side, then S-shapes
        (1.0, 3, 3, 3, 3),
        (4.0, 24, 3, 3, 1),
        (6.0, 28, 4, 3, 1),
        (7.5, 24, 2, 1, 8),
        (10.0, 3, 10, 2, 2),
        (12.0, 10, 2, 2, 14),
        (14.5, 16, 2, 2, 10),
        (17.0, 4, 3, 12, 3),
        (20.0, 3, 4, 4, 4),
    ],
    'b3': [  # brisk: within a second from side to side
        (1.0, 2, 4, 4, 4),
        (2.2, 2, 14, 3, 3),
        (3.4, 2, 3, 12, 3),
        (4.6, 2, 3, 3, 14),
        (6.0, 8, 3, 3, 4),
        (7.2, 3, 12, 10, 2),
        (8.4, 3, 2, 3, 12),
        (10.0, 3, 2, 3, 12),
        (11.2, 2, 14, 4, 2),
        (12.4, 10, 2, 12, 2),
        (14.0, 2, 2, 2, 2),
        (15.2, 2, 10, 2, 10),
        (16.4, 2, 2, 14, 4),
        (18.0, 4, 6, 6, 6),
        (20.0, 2, 4, 4, 4),
    ],
    'b4': [  # up and down: all tendons together, then released
        (1.0, 2, 3, 3, 3),
        (4.0, 5, 12, 12, 12),
        (6.5, 5, 16, 10, 12),
        (9.0, 2, 3, 3, 3),
        (11.5, 8, 8, 14, 12),
        (14.0, 12, 10, 12, 16),
        (16.5, 4, 4, 3, 8),
        (18.5, 2, 10, 4, 4),
        (20.0, 2, 3, 3, 3),
    ],
    'b5': [  # wide, to the walls and against what stands on the floor
        (1.0, 2, 3, 3, 3),
        (4.0, 10, 22, 2, 4),
        (6.5, 4, 20, 14, 1),
        (8.0, 1, 17, 17, 1),
        (9.5, 1, 13, 18, 1),
        (11.5, 1, 2, 20, 8),
        (14.0, 2, 2, 5, 28),
        (16.5, 6, 10, 2, 24),
        (18.5, 4, 8, 3, 6),
        (20.0, 2, 4, 3, 3),
    ],
    # b6, b7 and b8 touch. A slow arm curls up and passes over whatever stands on the floor; swung
    # at its natural period of 0.8 s, with little tension, it stays long and reaches it.
    'b6': [  # twice against the mustard bottle
        (1.0, 2, 3, 3, 3),
        (3.5, 2, 12, 3, 2),
        (5.5, 3, 2, 13, 2),
        (7.0, 2, 2, 2, 10),
        (7.4, 8, 3, 2, 1),
        (7.8, 2, 2, 2, 10),
        (8.2, 8, 3, 2, 1),
        (10.2, 2, 3, 3, 6),
        (12.4, 2, 12, 2, 10),
        (14.0, 2, 2, 2, 12),
        (14.4, 8, 3, 2, 1),
        (14.8, 2, 2, 2, 9),
        (15.2, 8, 3, 2, 1),
        (17.2, 2, 8, 3, 8),
        (20.0, 2, 3, 3, 3),
    ],
    'b7': [  # against the mustard bottle obliquely, swing after swing
        (1.0, 2, 3, 3, 3),
        (2.6, 12, 2, 2, 2),
        (4.2, 2, 1, 3, 12),
        (4.6, 8, 4, 2, 1),
        (5.0, 2, 1, 3, 12),
        (5.4, 8, 4, 2, 1),
        (5.8, 2, 1, 3, 12),
        (6.2, 7, 4, 2, 1),
        (8.0, 10, 2, 2, 9),
        (9.5, 2, 10, 2, 10),
        (11.0, 2, 3, 10, 8),
        (12.5, 2, 1, 3, 12),
        (12.9, 8, 4, 2, 1),
        (13.3, 2, 1, 3, 12),
        (13.7, 8, 4, 2, 1),
        (14.1, 2, 1, 3, 12),
        (14.5, 9, 4, 2, 1),
        (16.5, 14, 2, 6, 2),
        (18.5, 3, 10, 2, 3),
        (20.0, 2, 3, 3, 3),
    ],
    'b8': [  # twice against the cracker box
        (1.0, 2, 3, 3, 3),
        (3.0, 2, 2, 4, 14),
        (5.0, 3, 4, 18, 2),
        (6.6, 2, 8, 2, 6),
        (7.0, 3, 2, 10, 1),
        (7.4, 2, 8, 2, 6),
        (7.8, 3, 2, 9, 1),
        (9.5, 6, 2, 20, 2),
        (11.5, 2, 14, 3, 3),
        (13.5, 8, 2, 3, 12),
        (14.6, 2, 9, 2, 6),
        (15.0, 3, 2, 11, 1),
        (15.4, 2, 9, 2, 6),
        (15.8, 3, 2, 11, 1),
        (18.0, 2, 4, 14, 3),
        (20.0, 2, 3, 3, 3),
    ],
}

# The paper's grooves: curvature of the template [1/m], straight and arcs of 160 and 80 mm in
# diameter.
_GROOVES = {'straight': 0.0, 'groove160': 1.0 / 0.08, 'groove80': 1.0 / 0.04}

# Keyframes of the Hall arm in free bending: time [s], curvature about body y and z [1/m].
_FREE = {
    'free1': [
        (1.0, 0, 0),
        (3.0, 8, 0),
        (5.0, 0, 10),
        (7.0, -10, 4),
        (9.0, -4, -10),
        (11.0, 10, -6),
        (14.0, 14, 6),
        (16.0, 0, 16),
        (18.0, -8, 4),
        (20.0, 0, 0),
    ],
    'free2': [
        (1.0, 0, 0),
        (1.8, 10, 3),
        (2.6, -6, 8),
        (3.6, -12, -4),
        (4.6, 6, -10),
        (5.6, 6, 10),
        (7.0, 0, 0),
        (8.0, 14, 0),
        (9.0, -14, 0),
        (10.0, 0, 0),
    ],
}


def _box(name: str, robot: RobotDescription, plant: PlantSettings) -> Drive:
    rows = np.array(_BOX[name], float)
    return Drive(name, rows[:, 0], rows[:, 1:], np.zeros(len(rows)))


def _free(name: str, robot: RobotDescription, plant: PlantSettings) -> Drive:
    rows = np.array(_FREE[name], float)
    tensions = plant.tension_for_moments(plant.EI * rows[:, None, 1:])
    return Drive(name, rows[:, 0], tensions, np.zeros(len(rows)))


def _groove(name: str, robot: RobotDescription, plant: PlantSettings) -> Drive:
    """From straight into the groove within three seconds by a uniform moment, then still."""
    curvature = _GROOVES[name] * np.array([0.0, 1.0, 1.0])
    moments = plant.EI * np.stack([curvature, np.zeros(3)], axis=-1)[:, None, :]
    times = np.array([REST, REST + 3.0, REST + 9.0])
    return Drive(name, times, plant.tension_for_moments(moments), np.zeros(3), supported=True)


TRAJECTORIES = {
    'engine': dict.fromkeys(_ENGINE, _engine),
    'soft_arm': dict.fromkeys(_BOX, _box),
    'hall_arm': dict.fromkeys(_GROOVES, _groove) | dict.fromkeys(_FREE, _free),
}
