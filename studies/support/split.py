"""
Which trials the filter's numbers were tuned on.

Tables may show them, claims may not rest on them.
"""

from __future__ import annotations

from collections.abc import Iterable

from continuum_loc.errors import StudyError
from continuum_loc.offline.trials import Trial
from continuum_loc.offline.tune import HOLD_OUT
from continuum_loc.simulator.scenes import HOLD_OUT_SCENES

# The detector of anomalies: engine scenes of their own, which no table of results shows.
DETECTOR_HOLD_OUT = HOLD_OUT_SCENES


def is_hold_out(trial: Trial) -> bool:
    """Whether the trial's scene and trajectory are its robot's hold-out, whatever the seed."""
    held = HOLD_OUT.get(trial.robot)
    return held is not None and (trial.scene, trial.trajectory) == (held.scene, held.trajectory)


def require_unseen(trials: list[Trial]) -> None:
    """Raise StudyError where a claim would rest on a scene and trajectory that were tuned on."""
    seen = sorted({trial.name for trial in trials if is_hold_out(trial)})
    if seen:
        raise StudyError(f'tuned on, so no claim may rest on it: {", ".join(seen)}')


def require_new_scenes(scenes: Iterable[str]) -> None:
    """Raise StudyError when a claim would rest on a scene that the detector was tuned on."""
    seen = sorted(set(scenes) & set(DETECTOR_HOLD_OUT))
    if seen:
        raise StudyError(f'the detector was tuned on {", ".join(seen)}: no claim may rest on it')
