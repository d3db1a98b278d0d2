"""One trial from end to end: simulated, and localised in the map of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

from continuum_loc.mapping.map_files import load_map
from continuum_loc.offline.localise import make_filter, trial_settings
from continuum_loc.offline.replay import replay, ReplayResult
from continuum_loc.offline.scene_maps import MAP_POINTS, scene_map_file
from continuum_loc.offline.trials import simulate, Trial

if TYPE_CHECKING:
    from continuum_loc.estimator.settings import EstimatorSettings


def run_trial(trial: Trial, settings: EstimatorSettings | None = None) -> ReplayResult:
    """Simulate and estimate, both in this thread; only the estimator is timed."""
    return replay(
        simulate(trial),
        make_filter(
            trial.description, load_map(trial_map_file(trial)), settings or trial_settings(trial)
        ),
    )


def trial_map_file(trial: Trial) -> Path:
    """Name the file of the prior map that the estimator is given in a trial."""
    from continuum_loc.offline.scanned_maps import scanned_map_file

    nominal = scene_map_file(trial.map_scene or trial.scene)
    departures = trial.departures
    return scanned_map_file(nominal, departures, trial.seed) if departures.map_departs else nominal


def configuration(trial: Trial, **more: Any) -> dict[str, Any]:
    """Everything that a trial was made from, for its run folder; `more` adds to it."""
    return {
        'robot': trial.description,
        'scene': trial.scene,
        'trajectory': trial.trajectory,
        'map': {'scene': trial.map_scene or trial.scene, 'points': MAP_POINTS},
        'profile': trial.profile,
        'tof_fidelity': trial.fidelity,
        'disturbed': trial.disturbed,
        'world': trial.world,
        'seed': trial.seed,
        'duration': trial.duration,
        **more,
    }
