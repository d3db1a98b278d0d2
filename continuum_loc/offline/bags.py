"""Anyone's own bags, a folder of them: tables, claims and report as for simulated trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import json
from pathlib import Path
import traceback
from typing import Any

from continuum_loc.errors import BagError
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.map_files import load_map
from continuum_loc.mapping.scale import map_for
from continuum_loc.offline.account import account_of
from continuum_loc.offline.claims import at_most, Claim, write_study
from continuum_loc.offline.error_tables import figures, lost_share, ring_rows
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.parallel import (
    configuration_digest,
    Outcome,
    parallel,
    show_progress,
)
from continuum_loc.offline.replay import replay
from continuum_loc.offline.runs import save_run, summary_of
from continuum_loc.offline.source import content_digest, replay_digest
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.robot import RobotDescription
from msg_tools.bag import BAG_SUFFIXES


@dataclass(frozen=True)
class BagTrial:
    """A recorded trial; its name is unique in its folder."""

    bag: Path
    name: str


def bags_in(folder: Path) -> list[Path]:
    """
    List the bags directly in a folder: folders with a metadata.yaml, and single files.

    What is hidden is passed by: a recorder may still be at it. Raises BagError.
    """
    if not folder.is_dir():
        raise BagError(f'{folder}: no such folder; give one that holds bags')
    found = sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith('.')
        and ((path / 'metadata.yaml').is_file() or path.suffix in BAG_SUFFIXES)
    )
    if not found:
        raise BagError(
            f'{folder}: no bags in it; valid are folders with a metadata.yaml, and '
            f'{" and ".join(BAG_SUFFIXES)} files'
        )
    return found


def bag_trials(folder: Path) -> list[BagTrial]:
    """Name the bags of a folder by file or folder, with its ending where two would be the same."""
    bags = bags_in(folder)
    short = [bag.stem if bag.is_file() else bag.name for bag in bags]
    return [
        BagTrial(bag, name if short.count(name) == 1 else bag.name)
        for bag, name in zip(bags, short, strict=True)
    ]


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

    The one claim is that none failed. Raises BagError or MapError before any work.
    """
    trials = bag_trials(folder)
    map_for(robot, map_file)  # a map that cannot be used is no bag's fault
    work = [(trial, robot, map_file, settings, out) for trial in trials]
    outcomes = sorted(
        show_progress(parallel(replay_bag, work, jobs), len(work), 'estimating'),
        key=lambda one: one.trial.name,
    )
    claims = [at_most('bags that failed', sum(one.summary is None for one in outcomes), '', 0)]
    tables = {
        'bags': bag_rows(outcomes),
        'rings': ring_rows(outcomes, lambda trial: {'bag': trial.name}),
    }
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
        return Outcome(trial, _summary(trial, robot, map_file, settings, folder))
    except Exception as error:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / 'error.txt').write_text(traceback.format_exc())
        return Outcome(trial, None, f'{type(error).__name__}: {error}')


def _summary(
    trial: BagTrial,
    robot: RobotDescription,
    map_file: Path,
    settings: EstimatorSettings,
    folder: Path,
) -> dict[str, Any]:
    """Take the summary of an earlier run of the same, or run."""
    key = configuration_digest(
        robot, settings, replay_digest(), content_digest(map_file), content_digest(trial.bag)
    )
    if (folder / 'summary.json').is_file():
        summary = json.loads((folder / 'summary.json').read_text())
        if summary.get('configuration_digest') == key:
            return summary
    (folder / 'error.txt').unlink(missing_ok=True)
    result = replay(trial.bag, make_filter(robot, load_map(map_file), settings))
    account = account_of(robot, settings, result.counts, summary_of(result))
    if account['problems']:
        raise BagError('; '.join(account['problems']))
    return save_run(
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
        extra={'configuration_digest': key},
    )


def bag_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """
    One row per bag, mean and deviation over its rings, and one over all bags.

    A bag without truth has estimates, none of them judged.
    """
    groups = [(one.trial.name, [one]) for one in outcomes] + [('all', list(outcomes))]
    return [
        {
            'bag': name,
            **figures(members),
            'estimates': sum(one.summary['estimates']['all'] for one in members if one.summary),
            'judged': sum(one.summary['estimates']['judged'] for one in members if one.summary),
            'lost [%]': lost_share(members),
            'failed': sum(one.summary is None for one in members),
        }
        for name, members in groups
    ]
