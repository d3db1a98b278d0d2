"""
Tune the filter on a hold-out bag.

One number after another, by error and by consistency, as the papers did.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from continuum_loc.errors import TuneError
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.map_files import load_map
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.parallel import parallel
from continuum_loc.offline.replay import replay
from continuum_loc.offline.runs import summary_of
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
import numpy as np

PARAMETERS = (
    'prior.velocity',
    'prior.strain_rate',
    'prior.strain',
    'prior.velocity_slope',
    'tof.floor',
    'tof.cauchy',
    'gyro.scale',
    'strain.scale',
)
FACTORS = (0.33, 0.6, 1.7, 3.0)
# Error counts by its relative change; a NEES wrong by a factor of e costs as much as 20 % more
# error.
CONSISTENCY_WEIGHT = 0.2

# One hold-out per robot, as in the paper: a trajectory in a fully known environment, under a seed
# of its own.
HOLD_OUT = {
    'engine': Trial(robot='engine', scene='S0', trajectory='t1', seed=1000),
    'soft_arm': Trial(robot='soft_arm', scene='R4', trajectory='b1', seed=1000),
}


@dataclass(frozen=True)
class Trying:
    """One setting of the sweep and what it reached."""

    parameter: str
    factor: float
    translation_rmse_m: float
    rotation_rmse_deg: float
    nees_per_dof: float
    cost: float


def hold_out(robot: str) -> Trial:
    """
    Return the hold-out of a bundled robot.

    Raises TuneError for a robot that has none.
    """
    if robot not in HOLD_OUT:
        raise TuneError(
            f"robot '{robot}' has no hold-out of its own; give a bag and a map. "
            f'Robots that have one: {", ".join(HOLD_OUT)}'
        )
    return HOLD_OUT[robot]


def tune(
    bag: Path,
    robot: RobotDescription,
    map_file: Path,
    start: EstimatorSettings,
    jobs: int = 1,
    parameters: tuple[str, ...] = PARAMETERS,
    tell: Callable[[Trying], None] = lambda tried: None,
) -> tuple[EstimatorSettings, list[Trying]]:
    """
    Sweep each of `parameters` in turn over FACTORS times its value and keep what costs least.

    Returns the settings found and all that was tried, the start first. `tell` is called after
    each.
    """
    first = attempt(bag, robot, map_file, start, 'start', 1.0)
    if not math.isfinite(first.cost):
        raise TuneError(
            f'{bag}: no error can be told from it; a tuning bag holds `ground_truth/poses`'
        )
    tell(first)
    best, best_cost, tried = start, first.cost, [first]
    for name in parameters:
        candidates = {factor: scaled(best, name, factor) for factor in FACTORS}
        work = [
            (bag, robot, map_file, settings, name, factor)
            for factor, settings in candidates.items()
        ]
        for one in parallel(attempt, work, jobs):
            tell(one)
            tried.append(one)
            if one.cost < best_cost:
                best, best_cost = candidates[one.factor], one.cost
    return best, tried


def attempt(
    bag: Path,
    robot: RobotDescription,
    map_file: Path,
    settings: EstimatorSettings,
    parameter: str,
    factor: float,
) -> Trying:
    """Replay the bag with these settings."""
    summary = summary_of(replay(bag, make_filter(robot, load_map(map_file), settings)))
    error = (summary['translation_rmse_m'], summary['rotation_rmse_deg'])
    return Trying(
        parameter, factor, *error, summary['nees_per_dof'], cost(*error, summary['nees_per_dof'])
    )


def cost(translation_m: float, rotation_deg: float, nees_per_dof: float) -> float:
    """Mean of the logarithms of both errors, and how far the NEES is from 1 either way."""
    values = np.array([translation_m, rotation_deg, nees_per_dof])
    if not np.all(values > 0.0):
        return math.inf
    logs = np.log(values)
    return float(logs[:2].mean() + CONSISTENCY_WEIGHT * abs(logs[2]))


def scaled(settings: EstimatorSettings, name: str, factor: float) -> EstimatorSettings:
    """
    Multiply the number (or tuple of numbers) at the dotted `name` of `settings` by `factor`.

    Raises SettingsError where the result is out of range, TuneError for a name that is none.
    """
    data: dict[str, Any] = settings.model_dump()
    group = data
    *path, last = name.split('.')
    for part in path:
        group = group.get(part, {})
    if last not in group:
        raise TuneError(
            f"no setting '{name}'; numbers that can be swept: {', '.join(sorted(_numbers(data)))}"
        )
    value = group[last]
    group[last] = (
        tuple(factor * item for item in value) if isinstance(value, tuple) else factor * value
    )
    return parse_settings(EstimatorSettings, data, where=f'{name} x {factor:g}')


def _numbers(data: dict[str, Any], prefix: str = '') -> Iterator[str]:
    for name, value in data.items():
        if isinstance(value, dict):
            yield from _numbers(value, f'{prefix}{name}.')
        elif isinstance(value, (float, tuple)):
            yield prefix + name
