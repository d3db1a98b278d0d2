"""
Replays of simulated trials with something changed.

The filter's settings changed, the recording cut, or faults put in.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
import json
from pathlib import Path
import re
import traceback
from typing import Any

from continuum_loc.closure import is_ours
from continuum_loc.estimate import Estimate
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.map_files import load_map
from continuum_loc.measurements import Measurement, NANOSECONDS, nanoseconds, TruthSample
from continuum_loc.offline.as_json import write_json
from continuum_loc.offline.localise import make_filter, trial_settings
from continuum_loc.offline.metrics import Errors, errors
from continuum_loc.offline.replay import Filter, replay, samples_of
from continuum_loc.offline.runs import load_run, Run, save_run
from continuum_loc.offline.source import replay_digest
from continuum_loc.offline.trial_runs import configuration, trial_map_file
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot
from continuum_loc.settings import parse_settings
from continuum_loc.simulator.faults import Fault
from continuum_loc.trajectory import associate
import numpy as np
from studies.support.campaign import (
    bag_of,
    configuration_digest,
    made_by,
    parallel,
    record_bags,
    show_progress,
)

OFF = 0.05  # m: a ring farther from the truth is off


@dataclass(frozen=True)
class Case:
    """
    One replay of a trial's recording.

    name: of the variant, not of the trial. changes: the filter's settings that differ, by section
    as in YAML.
    start, end: what part of the recording the filter gets [s]. faults: wrappers, their times
    counted from `start`.
    """

    name: str
    trial: Trial
    changes: dict[str, Any] = field(default_factory=dict)
    start: float = 0.0
    end: float = float('inf')
    faults: tuple[Fault, ...] = ()

    @property
    def folder(self) -> str:
        """Where its run lies, unique among the cases of a study."""
        cut = f'-{self.start:g}s' if self.start else ''
        return re.sub(r'[^\w.-]+', '_', f'{self.name}-{self.trial.name}{cut}')


@dataclass(frozen=True, eq=False)
class CaseResult:
    """
    What became of a case.

    Without a run, `error` says why; the arrays are over the steps where truth is known.

    times: (K,) s since the filter's first sample. status: (K,). found: errors. For every step of
    `steps` (S,) s,
    accused: names of the sensors that the filter suspects; shares: of samples that fit, by sensor
    that it has heard; reasons: why each is suspected, and under `status` why the estimate is
    doubtful.
    """

    case: Case
    run: Run | None
    error: str = ''
    times: np.ndarray = field(default_factory=lambda: np.empty(0))
    status: np.ndarray = field(default_factory=lambda: np.empty(0, str))
    found: Errors | None = None
    steps: np.ndarray = field(default_factory=lambda: np.empty(0))
    accused: list[list[str]] = field(default_factory=list)
    shares: list[dict[str, float]] = field(default_factory=list)
    reasons: list[dict[str, str]] = field(default_factory=list)

    @property
    def worst_ring(self) -> np.ndarray:
        """(K,) translation error of the ring that is farthest off [m]."""
        return self.found.translation_m[:, 1:].max(axis=1)


class Witness:
    """A filter whose diagnostics are written down at every step."""

    def __init__(self, watched: Filter):
        self.watched, self.robot = watched, watched.robot
        self.log: list[dict[str, Any]] = []

    @property
    def counts(self) -> dict[str, Any]:
        """Return what the filter counts."""
        return self.watched.counts

    def process(self, measurement: Measurement) -> Estimate | None:
        """Pass a measurement on."""
        return self._note(self.watched.process(measurement))

    def flush(self) -> Estimate | None:
        """Pass the end on."""
        return self._note(self.watched.flush())

    def reset(self) -> None:
        """Pass a new start on."""
        self.watched.reset()

    def _note(self, estimate: Estimate | None) -> Estimate | None:
        if estimate is not None:
            self.log.append(
                {
                    'stamp': estimate.stamp,
                    'accused': list(estimate.suspects),
                    'reasons': dict(estimate.suspects),
                    'doubts': list(estimate.doubts),
                    'shares': dict(estimate.inliers),
                }
            )
        return estimate


def run_cases(cases: Sequence[Case], out: Path, jobs: int) -> list[CaseResult]:
    """Results in the order of `cases`; what `out` does not hold yet is simulated and replayed."""
    failed = record_bags([case.trial for case in cases], out, jobs)
    todo = [(out, case) for case in cases if case.trial.recording not in failed]
    problems = dict(show_progress(parallel(replay_case, todo, jobs), len(todo), 'estimating'))
    return [
        CaseResult(case, None, failed[case.trial.recording])
        if case.trial.recording in failed
        else load_case(out, case, problems[case.folder])
        for case in cases
    ]


def replay_case(out: Path, case: Case) -> tuple[str, str]:
    """
    Replay a case into its run folder unless it is there.

    Returns (its folder's name, what went wrong or "").
    """
    folder = out / 'cases' / case.folder
    try:
        _replay(out, case, folder)
    except Exception as error:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'error.txt').write_text(traceback.format_exc())
        return case.folder, f'{type(error).__name__}: {error}'
    return case.folder, ''


def _replay(out: Path, case: Case, folder: Path) -> None:
    trial, settings = case.trial, case_settings(case)
    resolved = configuration(trial, estimator=settings, case=case, faults=repr(case.faults))
    bag, map_file = bag_of(out, trial), trial_map_file(trial)
    key = configuration_digest(resolved, code_of(case), made_by(bag), map_file.name)
    if _digest(folder) == key:
        return
    witness = Witness(make_filter(load_robot(trial.robot), load_map(map_file), settings))
    result = replay(case_samples(samples_of(bag), case), witness)
    (folder / 'error.txt').unlink(missing_ok=True)
    save_run(
        folder,
        result,
        kind='case',
        seed=trial.seed,
        configuration=resolved,
        extra={'case_digest': key},
    )
    write_json(folder / 'diagnostics.json', witness.log)


def code_of(case: Case) -> str:
    """Digest the code that decides a case: kinds of faults may come from any module of ours."""
    kinds = {type(fault).__module__ for fault in case.faults}
    return replay_digest(__name__, *sorted(name for name in kinds if is_ours(name)))


def _digest(folder: Path) -> str | None:
    files = [folder / 'summary.json', folder / 'diagnostics.json']
    return (
        json.loads(files[0].read_text())['case_digest']
        if all(file.is_file() for file in files)
        else None
    )


def case_settings(case: Case) -> EstimatorSettings:
    """Change the settings that come with the robot as the case says. Raises SettingsError."""
    data = trial_settings(case.trial).model_dump()
    for section, value in case.changes.items():
        data[section] = {**data[section], **value} if isinstance(value, dict) else value
    return parse_settings(EstimatorSettings, data, where=case.name)


def case_samples(
    samples: Iterable[Measurement | TruthSample], case: Case
) -> Iterator[Measurement | TruthSample]:
    """Cut out the part of a recording that the case wants, with its faults."""
    stream = cut(samples, case.start, case.end)
    for fault in case.faults:
        stream = fault(stream)
    return stream


def cut(
    samples: Iterable[Measurement | TruthSample], start: float, end: float
) -> Iterator[Measurement | TruthSample]:
    """Keep the samples whose stamps lie in [start, end) seconds after the first one's."""
    epoch = None
    for sample in samples:
        epoch = sample.stamp if epoch is None else epoch
        if sample.stamp - epoch >= (nanoseconds(end) if np.isfinite(end) else np.inf):
            return
        if sample.stamp - epoch >= nanoseconds(start):
            yield sample


def load_case(out: Path, case: Case, error: str = '') -> CaseResult:
    """Read a case's run folder back and compare it with the truth."""
    if error:
        return CaseResult(case, None, error)
    folder = out / 'cases' / case.folder
    run = load_run(folder)
    track, truth = run.result.track, run.result.truth
    if len(track) == 0:
        return CaseResult(case, None, 'the filter gave no estimate')
    found = errors(track, truth)
    epoch = truth.stamps[0]
    log = json.loads((folder / 'diagnostics.json').read_text())
    return CaseResult(
        case,
        run,
        '',
        (found.stamps - epoch) / NANOSECONDS,
        associate(track, truth)[0].status,
        found,
        np.array([(entry['stamp'] - epoch) / NANOSECONDS for entry in log]),
        [entry['accused'] for entry in log],
        [entry['shares'] for entry in log],
        [
            entry['reasons'] | ({'status': '; '.join(entry['doubts'])} if entry['doubts'] else {})
            for entry in log
        ],
    )


def longest_unannounced(result: CaseResult) -> float:
    """Find the longest time [s] for which a ring is off while the filter says it is tracking."""
    off = (result.found.translation_m[:, 1:] > OFF) & (result.status == 'tracking')[:, None]
    return max(longest_stretch(result.times, off[:, ring]) for ring in range(off.shape[1]))


def longest_stretch(times: np.ndarray, flags: np.ndarray) -> float:
    """
    Find the longest time [s] over which `flags` (K,) stay true at consecutive `times` (K,).

    Each counts until the next, the last one for the usual distance between them.
    """
    if not np.any(flags):
        return 0.0
    usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    edges = np.diff(np.concatenate([[0], flags.astype(int), [0]]))
    until = np.append(times[1:], times[-1] + usual)
    return float(np.max(until[np.flatnonzero(edges < 0) - 1] - times[np.flatnonzero(edges > 0)]))


def settled_since(times: np.ndarray, flags: np.ndarray) -> float:
    """Find the first of `times` (K,) from which on `flags` (K,) stay true, or inf."""
    wrong = np.flatnonzero(~flags)
    if len(wrong) == 0:
        return float(times[0])
    return float(times[wrong[-1] + 1]) if wrong[-1] + 1 < len(times) else float('inf')


def failures(results: Sequence[CaseResult]) -> dict[str, str]:
    """List the cases that gave nothing, and why."""
    return {result.case.folder: result.error for result in results if result.run is None}
