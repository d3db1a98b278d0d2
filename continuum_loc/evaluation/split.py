"""
Which trials the filter's numbers were tuned on.

Tables may show them, claims may not rest on them.
"""

from __future__ import annotations

from continuum_loc.evaluation.trials import Trial

# One hold-out per robot, as in the paper: a trajectory in a fully known environment, under a seed
# of its own.
HOLD_OUT = {
    'engine': Trial(robot='engine', scene='S0', trajectory='t1', seed=1000),
    'soft_arm': Trial(robot='soft_arm', scene='R4', trajectory='b1', seed=1000),
}


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
