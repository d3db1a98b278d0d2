"""
Many trials in several processes.

One failure takes no other along, and an interrupted campaign continues.

OUT/bags/<recording>/     what was simulated, kept: trials that differ in map or settings replay
                          the same bag; made anew when the trial, a file that it names or the
                          simulator's code has changed
OUT/trials/<trial>/       a run folder per trial, or `error.txt` with what went wrong; run anew
                          when configuration, recording, map or the filter's code has changed
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
import json
import os
from pathlib import Path
import shutil
import traceback
from typing import Any, TYPE_CHECKING

from continuum_loc.errors import StudyError
from continuum_loc.offline.as_json import plain
from continuum_loc.offline.parallel import (
    configuration_digest,
    Outcome,
    parallel,
    Progress,
    show_progress,
)
from continuum_loc.offline.source import content_digest, replay_digest, simulation_digest
from continuum_loc.offline.trials import Trial

if TYPE_CHECKING:
    from continuum_loc.estimator.settings import EstimatorSettings

ONLY_ESTIMATED = ('map_scene', 'base')  # what a trial's recording does not depend on
MADE_BY = 'made_by.txt'  # in a recording's folder: the digest of what it was simulated from


def run_campaign(
    trials: Sequence[Trial],
    out: Path,
    jobs: int = 1,
    settings: EstimatorSettings | None = None,
    progress: Progress | None = None,
) -> list[Outcome]:
    """
    Run the trials that have not been run yet, and return all outcomes in the order of `trials`.

    The number of jobs changes nothing but the time: each trial is seeded and runs in one process
    by itself.
    """
    progress = progress or show_progress
    require_names(trials)
    failed = record_bags(trials, out, jobs, progress)
    todo = [(out, trial, settings) for trial in trials if trial.recording not in failed]
    found = {}
    for outcome in progress(parallel(_estimate, todo, jobs), len(todo), 'estimating'):
        found[outcome.trial] = outcome
    return [found.get(trial) or Outcome(trial, None, failed[trial.recording]) for trial in trials]


def record_bags(
    trials: Sequence[Trial], out: Path, jobs: int = 1, progress: Progress | None = None
) -> dict[str, str]:
    """
    Simulate the recordings of `trials` that `out` does not hold yet, or holds from other code.

    Returns {recording: error} of what failed.
    """
    progress = progress or show_progress
    bags = one_of_each_recording(trials)
    todo = [(out, trial) for trial in bags if not recorded(bag_of(out, trial), trial)]
    failed = {}
    for done in progress(parallel(_record, todo, jobs), len(todo), 'simulating'):
        failed |= done
    return failed


def bag_of(out: Path, trial: Trial) -> Path:
    """Where the campaign in `out` keeps the bag of a trial."""
    return out / 'bags' / trial.recording


def require_names(trials: Sequence[Trial]) -> None:
    """Raise StudyError where two different trials have one name, under which results lie."""
    by_name: dict[str, Trial] = {}
    for trial in trials:
        if by_name.setdefault(trial.name, trial) != trial:
            raise StudyError(f"two different trials are called '{trial.name}'")


def one_of_each_recording(trials: Sequence[Trial]) -> list[Trial]:
    """
    Return the first trial of each recording.

    Raises StudyError where two would be recorded under one name, and are not the same.
    """
    first: dict[str, Trial] = {}
    for trial in trials:
        known = first.setdefault(trial.recording, trial)
        if known is not trial and made_from(known) != made_from(trial):
            raise StudyError(
                f"two trials are recorded as '{trial.recording}' and are not the same: "
                'give robots, scenes, trajectories and plants names of their own'
            )
    return list(first.values())


def recorded(bag: Path, trial: Trial) -> bool:
    """
    Whether a recording is there, and is what the simulator as it is makes of the trial.

    One that does not say what made it was put there by somebody, who will know.
    """
    return bag.is_dir() and _mark(bag) in ('', made_from(trial))


def made_from(trial: Trial) -> str:
    """Digest all that decides a trial's recording: what it says, files it names, and code."""
    said = {name: value for name, value in asdict(trial).items() if name not in ONLY_ESTIMATED}
    files = {
        name: content_digest(Path(value))
        for name, value in said.items()
        if isinstance(value, str) and Path(value).is_file()
    }
    return configuration_digest(said, files, simulation_digest())


def made_by(bag: Path) -> str:
    """Return what tells a recording from another: what it was made from, else its content."""
    return _mark(bag) or content_digest(bag)


def _mark(bag: Path) -> str:
    mark = bag / MADE_BY
    return mark.read_text().strip() if mark.is_file() else ''


def _remove(bag: Path) -> None:
    if bag.is_symlink():
        bag.unlink()
    elif bag.is_dir():
        shutil.rmtree(bag)


def _record(out: Path, trial: Trial) -> dict[str, str]:
    """Simulate into a bag. Returns {recording: error} of what failed."""
    from continuum_loc.offline.trials import simulate, write_bag

    bag = bag_of(out, trial)
    partial = bag.with_name(f'.{bag.name}.{os.getpid()}')
    try:
        bag.parent.mkdir(parents=True, exist_ok=True)
        write_bag(partial, simulate(trial))
        (partial / MADE_BY).write_text(made_from(trial) + '\n')
        _remove(bag)
        partial.rename(bag)  # a bag under its name is a whole one
    except Exception as error:
        shutil.rmtree(partial, ignore_errors=True)
        return {trial.recording: f'simulating: {type(error).__name__}: {error}'}
    return {}


def _estimate(out: Path, trial: Trial, settings: EstimatorSettings | None) -> Outcome:
    """Replay a trial's bag, or take the result of an earlier run with the same configuration."""
    folder = out / 'trials' / trial.name
    try:
        return _run(folder, bag_of(out, trial), trial, settings)
    except Exception as error:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'error.txt').write_text(traceback.format_exc())
        return Outcome(trial, None, f'{type(error).__name__}: {error}')


def _run(folder: Path, bag: Path, trial: Trial, settings: EstimatorSettings | None) -> Outcome:
    from continuum_loc.mapping.map_files import load_map
    from continuum_loc.offline.localise import make_filter, trial_settings
    from continuum_loc.offline.replay import replay
    from continuum_loc.offline.runs import save_run
    from continuum_loc.offline.trial_runs import configuration, trial_map_file

    settings = settings or trial_settings(trial)
    map_file = trial_map_file(trial)
    resolved = configuration(trial, estimator=settings)
    key = configuration_digest(
        resolved, asdict(trial), replay_digest(__name__), made_by(bag), map_file.name
    )
    summary_file = folder / 'summary.json'
    if summary_file.is_file():
        summary = json.loads(summary_file.read_text())
        if summary.get('configuration_digest') == key:
            return Outcome(trial, _complete(summary, folder))
    (folder / 'error.txt').unlink(missing_ok=True)
    estimator = make_filter(trial.description, load_map(map_file), settings)
    result = replay(bag, estimator)
    return Outcome(
        trial,
        save_run(
            folder,
            result,
            kind='trial',
            seed=trial.seed,
            configuration=resolved,
            extra={'configuration_digest': key},
        ),
    )


def _complete(summary: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the summary with the figures that were not computed yet when its run was made."""
    from continuum_loc.offline.runs import load_run, summary_of

    if 'silent_seconds' in summary:
        return summary
    return summary | plain(summary_of(load_run(folder).result))
