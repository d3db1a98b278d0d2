"""
Which trials the filter's numbers were tuned on.

Tables may show them, claims may not rest on them.
"""

from __future__ import annotations

from collections.abc import Iterable

from continuum_loc.evaluation.trials import Trial
from continuum_loc.simulator.scenes import HOLD_OUT_SCENES

# One hold-out per robot, as in the paper: a trajectory in a fully known environment, under a seed
# of its own.
HOLD_OUT = {
    'engine': Trial(robot='engine', scene='S0', trajectory='t1', seed=1000),
    'soft_arm': Trial(robot='soft_arm', scene='R4', trajectory='b1', seed=1000),
}

# The detector of anomalies: engine scenes of their own, which no table of results shows.
DETECTOR_HOLD_OUT = HOLD_OUT_SCENES


class SplitError(ValueError):
    """A trial on the wrong side of the split."""


def hold_out(robot: str) -> Trial:
    """
    Return the hold-out of a bundled robot.

    Raises SplitError for a robot that has none.
    """
    if robot not in HOLD_OUT:
        raise SplitError(
            f"robot '{robot}' has no hold-out of its own; give a bag and a map. "
            f'Robots that have one: {", ".join(HOLD_OUT)}'
        )
    return HOLD_OUT[robot]


def is_hold_out(trial: Trial) -> bool:
    """Whether the trial's scene and trajectory are its robot's hold-out, whatever the seed."""
    held = HOLD_OUT.get(trial.robot)
    return held is not None and (trial.scene, trial.trajectory) == (held.scene, held.trajectory)


def require_unseen(trials: list[Trial]) -> None:
    """
    Raise SplitError where a claim would rest on what the filter was tuned on.

    That is a scene with a trajectory.
    """
    seen = sorted({trial.name for trial in trials if is_hold_out(trial)})
    if seen:
        raise SplitError(f'tuned on, so no claim may rest on it: {", ".join(seen)}')


def require_new_scenes(scenes: Iterable[str]) -> None:
    """Raise SplitError when a claim would rest on a scene that the detector was tuned on."""
    seen = sorted(set(scenes) & set(DETECTOR_HOLD_OUT))
    if seen:
        raise SplitError(f'the detector was tuned on {", ".join(seen)}: no claim may rest on it')
