"""Forces on a simulated robot in free space, and what the filter makes of them."""

from __future__ import annotations

from dataclasses import dataclass

from continuum_loc.estimator import settings_of, SlidingWindowFilter
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.measurements import seconds, TruthSample
from continuum_loc.settings import parse_settings
from continuum_loc.simulator.forces import Push
from continuum_loc.simulator.world import START, World
import numpy as np
from studies.support.actuated import simulated_robot

FROM, UNTIL, SETTLED = 4.0, 8.0, 0.5  # [s] of the push; after it has settled
SIDES = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class Found:
    """
    What was told of one push.

    after: [s] until it was first told; told: share of the time after; size, place, nees: of what
    was told once it had settled; false: estimates before it with a force.
    """

    robot: str
    s: float
    force: float
    after: float
    told: float
    size: float
    place: float
    nees: float
    false: int

    def row(self) -> dict[str, float | str]:
        return {
            'robot': self.robot,
            'at s [m]': self.s,
            'force [N]': self.force,
            'found after [s]': self.after,
            'told [%]': 100.0 * self.told,
            'size, median error [%]': 100.0 * self.size,
            'place, median error [cm]': 100.0 * self.place,
            'NEES/dof': self.nees,
            'false before [estimates]': self.false,
        }


def pushed(robot: str, trajectory: str, s: float, size: float, seed: int) -> Found:
    """Push sideways and upward in turn, by where the seed is even or odd, and see what is told."""
    description = simulated_robot(robot)
    force = size * np.array(SIDES[seed % 2])
    push = Push(s, tuple(force.tolist()), FROM, UNTIL)
    world = World(description, None, trajectory, seed=seed, pushes=(push,))
    known = settings_of(robot).model_dump()
    known['tof']['enabled'] = False
    estimator = SlidingWindowFilter(description, None, parse_settings(EstimatorSettings, known))
    told = []
    for sample in world.run(UNTIL):
        if isinstance(sample, TruthSample):
            continue
        estimate = estimator.process(sample)
        if estimate is not None:
            told.append((seconds(estimate.stamp, START), estimate.loads))
    return _judged(robot, s, force, told)


def _judged(robot: str, s: float, force: np.ndarray, told: list) -> Found:
    during = [(time - FROM, loads) for time, loads in told if time > FROM]
    settled = [loads[0] for time, loads in during if loads and time > SETTLED]
    size = float(np.linalg.norm(force))
    nees = [
        (one.force - force) @ np.linalg.solve(one.covariance, one.force - force) / 3.0
        for one in settled
    ]
    return Found(
        robot,
        s,
        size,
        next((time for time, loads in during if loads), float('inf')),
        float(np.mean([bool(loads) for _, loads in during])),
        _median([abs(np.linalg.norm(one.force) - size) / size for one in settled]),
        _median([abs(one.s - s) for one in settled]),
        float(np.mean(nees)) if nees else float('nan'),
        sum(bool(loads) for time, loads in told if time < FROM),
    )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float('nan')
