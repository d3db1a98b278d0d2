"""Anyone's own bags, a folder of them: tables, claims and report as for simulated trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
import traceback
from typing import Any

from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.evaluation.campaign import Outcome, parallel, show_progress
from continuum_loc.evaluation.error_tables import figures, lost_share
from continuum_loc.evaluation.replay import replay
from continuum_loc.evaluation.runs import save_run
from continuum_loc.evaluation.study import at_most, Claim, write_study
from continuum_loc.evaluation.study_report import write_study_report
from continuum_loc.evaluation.trials import make_filter
from continuum_loc.mapping.map_files import load_map
from continuum_loc.robot import RobotDescription

BAG_SUFFIXES = ('.mcap', '.db3')


class BagsError(ValueError):
    """A folder without bags."""


@dataclass(frozen=True)
class BagTrial:
    """A recorded trial, named by its file."""

    bag: Path

    @property
    def name(self) -> str:
        """Return the bag's folder or file without its ending."""
        return self.bag.stem if self.bag.is_file() else self.bag.name


def bags_in(folder: Path) -> list[Path]:
    """
    List the bags directly in a folder: folders with a metadata.yaml, and single files.

    Raises BagsError.
    """
    if not folder.is_dir():
        raise BagsError(f'{folder}: no such folder; give one that holds bags')
    found = sorted(
        path
        for path in folder.iterdir()
        if (path / 'metadata.yaml').is_file() or path.suffix in BAG_SUFFIXES
    )
    if not found:
        raise BagsError(
            f'{folder}: no bags in it; valid are folders with a metadata.yaml, and '
            f'{" and ".join(BAG_SUFFIXES)} files'
        )
    return found


def evaluate_bags(
    folder: Path,
    robot: RobotDescription,
    map_file: Path,
    settings: EstimatorSettings,
    out: Path,
    jobs: int = 1,
) -> list[Claim]:
    """
    Replay every bag of `folder`; tables, run folders and report go to `out`.

    The one claim is that none failed.
    """
    work = [(BagTrial(bag), robot, map_file, settings, out) for bag in bags_in(folder)]
    outcomes = sorted(
        show_progress(parallel(replay_bag, work, jobs), len(work), 'estimating'),
        key=lambda one: one.trial.name,
    )
    claims = [at_most('bags that failed', sum(one.summary is None for one in outcomes), '', 0)]
    tables = {'bags': bag_rows(outcomes)}
    write_study(
        out,
        claims,
        seed=0,
        settings={'robot': robot, 'map': map_file, 'estimator': settings},
        tables=tables,
        extra={'failed': {one.trial.name: one.error for one in outcomes if one.error}},
    )
    write_study_report(
        out, f'Bags of {folder.name}', claims, {'Errors by bag': tables['bags']}, outcomes
    )
    return claims


def replay_bag(
    trial: BagTrial,
    robot: RobotDescription,
    map_file: Path,
    settings: EstimatorSettings,
    out: Path,
) -> Outcome:
    """One bag into a run folder; an error is told, and takes no other bag along."""
    folder = out / 'trials' / trial.name
    try:
        result = replay(trial.bag, make_filter(robot, load_map(map_file), settings))
        summary = save_run(
            folder,
            result,
            kind='bag',
            seed=None,
            configuration={
                'robot': robot,
                'bag': trial.bag,
                'map': {'file': map_file},
                'estimator': settings,
            },
        )
    except Exception as error:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'error.txt').write_text(traceback.format_exc())
        return Outcome(trial, None, f'{type(error).__name__}: {error}')
    return Outcome(trial, summary)


def bag_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per bag, mean and deviation over its rings, and one over all bags."""
    groups = [(one.trial.name, [one]) for one in outcomes] + [('all', list(outcomes))]
    return [
        {
            'bag': name,
            **figures(members),
            'lost [%]': lost_share(members),
            'failed': sum(one.summary is None for one in members),
        }
        for name, members in groups
    ]
