"""
Whether a map and a robot can belong together: their sizes, and where they are.

Nothing in a cloud says whether its numbers are metres or millimetres. A robot beside it does: what
surrounds a robot is neither a thousandth of its size nor a thousand times as large.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from continuum_loc.errors import MapError
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.robot import RobotDescription
import numpy as np

# Longest edge of a map [m] that is told even without a robot, as the simulator's scenes are.
SMALLEST, LARGEST = 0.05, 50.0
# Longest edge of a map over the reach of a robot. An engine has 2, a hall 50. A map in millimetres
# has a thousand times what it should have, a map in metres beside a robot in millimetres a
# thousandth: what is beyond the outer bounds cannot be used in any case, what is beyond the inner
# ones is odd.
LEAST, FEW, MANY, MOST = 0.02, 0.1, 50.0, 300.0
SPARSE = 0.3  # points farther apart than this share of the reach, in a map of many reaches
STRAYS = 0.005  # share of points at each end of an axis that may be a scanner's strays


def extent(prior: PriorMap) -> float:
    """Longest edge of the map's box [m], without stray points."""
    if len(prior) < 1.0 / STRAYS:
        return float(np.ptp(prior.points, axis=0).max())
    low, high = np.quantile(prior.points, [STRAYS, 1.0 - STRAYS], axis=0)
    return float((high - low).max())


def size_note(prior: PriorMap) -> tuple[str, ...]:
    """Say that a map has an unlikely size; nothing where it has a likely one."""
    edge = extent(prior)
    if edge > LARGEST:
        return (f'measures {edge:.4g} m, which looks like millimetres{_by(0.001)}',)
    if 0.0 < edge < SMALLEST:
        return (f'measures {edge:.4g} m, a thousandth of a likely size{_by(1000.0)}',)
    return ()


def check_scale(robot: RobotDescription, prior: PriorMap) -> tuple[str, ...]:
    """
    Compare the sizes and places of a robot and a map.

    Returns what is doubtful, in words; nothing for a robot without ToF sensors, which uses no map.
    Raises MapError where one is so large or small for the other that their units must differ.
    """
    if not robot.tof:
        return ()
    reach = _reach(robot)
    edge = extent(prior)
    ratio = edge / reach
    sizes = f"measures {edge:.4g} m and robot '{robot.name}' reaches {reach:.4g} m"
    name = prior.source or 'the map'
    if ratio > MOST or (ratio > MANY and prior.spacing > SPARSE * reach):
        raise MapError(f'{name}: {sizes}; the map looks like millimetres{_by(0.001)}')
    if ratio < LEAST:
        raise MapError(
            f'{name}: {sizes}; the robot description looks like millimetres, or the map was '
            f'scaled twice{_by(1000.0)}'
        )
    if not FEW <= ratio <= MANY:
        return (f'{sizes}: are both in metres?',)
    return _distance_note(robot, prior, reach)


def map_for(robot: RobotDescription, path: str | Path) -> PriorMap:
    """
    Load a prior map for a robot; what is doubtful about the two is among its `notes`.

    Raises MapError where it cannot be read, or cannot be this robot's surroundings.
    """
    prior = load_map(path)
    notes = check_scale(robot, prior)
    return replace(prior, notes=(*prior.notes, *notes)) if notes else prior


def _reach(robot: RobotDescription) -> float:
    """How far from its base at zero insertion a robot can get [m]."""
    travel = robot.base.insertion.range
    return robot.length + max(travel[1], -travel[0], 0.0)


def _distance_note(robot: RobotDescription, prior: PriorMap, reach: float) -> tuple[str, ...]:
    """Say that no ToF sensor can see the map from where the description puts the base."""
    seen = reach + robot.tof_model.max_range
    nearest = float(np.linalg.norm(prior.points - robot.base.xyz, axis=1).min())
    if nearest <= seen:
        return ()
    return (
        f"is {nearest:.4g} m away from the base of robot '{robot.name}', whose sensors see "
        f'{seen:.4g} m far: is `base` in the frame and the unit of the map?',
    )


def _by(scale: float) -> str:
    return f'; `continuum-loc map convert IN OUT --scale {scale:g}` makes metres of it'
