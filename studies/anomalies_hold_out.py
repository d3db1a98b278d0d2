"""What the detector of anomalies was tuned on: engine scenes H1-H3, which no claim rests on."""

from __future__ import annotations

from pathlib import Path

from continuum_loc.offline.claims import Claim
from continuum_loc.offline.trials import Trial
from studies.anomalies import run_scenes
from studies.support.split import DETECTOR_HOLD_OUT
from studies.table2 import TRAJECTORIES


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Run the `anomalies` study on the hold-out (`quick`: six seconds in one scene)."""
    return run_scenes(out, out / 'anomalies', trials(quick, seed), seed, jobs, tuning=True)


def trials(quick: bool, seed: int) -> list[Trial]:
    """Three trials in each scene of the hold-out, all with the map of S0."""
    if quick:
        return [Trial('engine', 'H3', 't2', 'S0', seed=seed, duration=6.0)]
    return [
        Trial('engine', scene, trajectory, 'S0', profile='full', seed=seed)
        for scene in DETECTOR_HOLD_OUT
        for trajectory in TRAJECTORIES
    ]
