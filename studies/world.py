"""
What each departure of the true world from the estimator's files costs, alone and all together.

One trajectory of the engine and one of the soft arm, over several seeds: first in the ideal world,
then with one part of `disturbed` at a time, then with all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_most, between, Claim, write_study
from continuum_loc.offline.error_tables import trial_rows
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.simulator.departures import load_departures
import numpy as np
from studies.support.campaign import Outcome, run_campaign
from studies.support.split import HOLD_OUT, require_unseen

IDEAL, WORLD = 'ideal', 'disturbed'
# Robot, scene, trajectory; and what tables II and III ask for: cm, deg.
SUBJECTS = {
    'engine': ('S0', 't2', 0.2, 0.3),
    'soft_arm': ('R1', 'b2', 0.9, 2.6),
}
SEEDS = 3
DURATION = 10.0
# What the quick run has of the parts, and how long.
QUICK_PARTS, QUICK_DURATION = ('tof', 'mounts', 'range', 'clocks'), 3.0
NEES, COVERAGE = (0.7, 1.5), (0.90, 0.98)
# Table's column -> figure of a summary, factor.
COLUMNS = {
    'cm': ('translation_mae_m', 100.0),
    'deg': ('rotation_mae_deg', 1.0),
    'NEES/dof': ('nees_per_dof', 1.0),
    'inside 95 % [%]': ('coverage_95', 100.0),
}


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Run every departure and judge the ideal world and the whole disturbed one."""
    wanted = trials(quick, seed)
    require_unseen(wanted)
    outcomes = run_campaign(wanted, out, jobs)
    claims = judge(outcomes)
    tables = {
        'departures': departure_rows(outcomes),
        'rings': ring_rows(outcomes),
        'trials': trial_rows(outcomes),
    }
    write_study(
        out,
        claims,
        seed=seed,
        settings={'trials': wanted, 'world': load_departures(WORLD)},
        tables=tables,
        extra={
            'quick': quick,
            'hold_out': HOLD_OUT,
            'failed': {one.trial.name: one.error for one in outcomes if one.error},
        },
    )
    write_study_report(
        out,
        'What the departures of the world cost',
        claims,
        {'Departures': tables['departures'], 'By ring': tables['rings']},
        outcomes,
    )
    return claims


def trials(quick: bool, seed: int) -> list[Trial]:
    """List each subject in the ideal world, with every part that concerns it, and with all."""
    wanted = []
    for robot, (scene, trajectory, *_) in SUBJECTS.items():
        parts = concerned(load_robot(robot))
        if quick:
            parts = (
                tuple(part for part in parts if part in QUICK_PARTS) if robot == 'engine' else ()
            )
        worlds = (IDEAL, *(f'{WORLD}:{part}' for part in parts), WORLD)
        wanted += [
            Trial(
                robot,
                scene,
                trajectory,
                seed=seed + number,
                duration=QUICK_DURATION if quick else DURATION,
                world=world,
            )
            for world in worlds
            for number in range(1 if quick else SEEDS)
        ]
    return wanted


def concerned(robot: RobotDescription) -> tuple[str, ...]:
    """Parts of the disturbed world that can concern a robot's localisation."""
    has = {
        'tof': robot.tof,
        'range': robot.tof,
        'gyro': robot.imu,
        'strain': robot.strain,
        'hall': robot.hall,
        'magnet': robot.magnet,
    }
    return tuple(part for part in load_departures(WORLD).parts if has.get(part, True))


def condition(outcome: Outcome) -> str:
    """Name what departs in a trial."""
    world = outcome.trial.world
    return {IDEAL: 'nothing', WORLD: 'all together'}.get(world, world.partition(':')[2])


def groups(outcomes: Sequence[Outcome]) -> dict[tuple[str, str], list[Outcome]]:
    """Outcomes by robot and by what departs, in order of appearance."""
    found: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        found.setdefault((outcome.trial.robot, condition(outcome)), []).append(outcome)
    return found


def departure_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per robot and departure: means over seeds and rings."""
    return [
        {
            'robot': robot,
            'departs by': name,
            **figures(members),
            'trials': sum(one.summary is not None for one in members),
            'lost [%]': 100.0 * mean_of([lost_share(one) for one in members]),
        }
        for (robot, name), members in groups(outcomes).items()
    ]


def ring_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per robot, departure and ring: means over seeds."""
    return [
        {'robot': robot, 'departs by': name, 'ring': ring, **figures(members, ring)}
        for (robot, name), members in groups(outcomes).items()
        for ring in load_robot(robot).ring_names
    ]


def figures(members: Sequence[Outcome], ring: str | None = None) -> dict[str, float]:
    """Each of COLUMNS, a mean over trials (and rings, but for one `ring`)."""
    done = [one.summary for one in members if one.summary is not None]
    entries = [summary if ring is None else summary['rings'][ring] for summary in done]
    return {
        column: factor * mean_of([entry[key] for entry in entries])
        for column, (key, factor) in COLUMNS.items()
    }


def mean_of(values: Sequence[float | None]) -> float:
    """Mean of those that are known, nan of none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float('nan')


def lost_share(outcome: Outcome) -> float | None:
    """Share of a trial's estimates at which the filter said `lost`."""
    if outcome.summary is None:
        return None
    counts = outcome.summary['estimates']
    return counts['lost'] / max(counts['all'], 1)


def judge(outcomes: Sequence[Outcome]) -> list[Claim]:
    """Ask of both worlds what tables II, III and `consistency` ask, of each robot."""
    claims = []
    for (robot, name), members in groups(outcomes).items():
        if name not in ('nothing', 'all together'):
            continue
        found, (_, _, translation, rotation) = figures(members), SUBJECTS[robot]
        world = IDEAL if name == 'nothing' else WORLD
        claims += [
            at_most(f'{robot}, {world}: translation MAE', found['cm'], 'cm', translation),
            at_most(f'{robot}, {world}: rotation MAE', found['deg'], 'deg', rotation),
            between(f'{robot}, {world}: NEES per degree of freedom', found['NEES/dof'], '', *NEES),
            between(
                f'{robot}, {world}: coverage of the 95 % bound',
                0.01 * found['inside 95 % [%]'],
                '',
                *COVERAGE,
            ),
        ]
    failed = sum(one.summary is None for one in outcomes)
    return [*claims, at_most('trials that failed', failed, '', 0)]
