"""
The base is anywhere: carried and measured, drifting, free, said to be fixed, unknown, kidnapped.

The engine robot in its scenes with the map of S0, its base carried by 0.5 m and 30 deg; the Hall
arm on a wrist; and starts of the engine robot and the soft arm from nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_least, at_most, between, Claim, write_study
from continuum_loc.offline.parallel import parallel, show_progress
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.offline.trials import Trial
import numpy as np
from studies._base_hall import hall_rows
from studies._base_runs import Followed, followed
from studies._base_starts import kidnap, START_CASES, started
from studies.support.campaign import bag_of, record_bags

SCENES, QUICK_SCENES = tuple(f'S{i}' for i in range(10)), ('S0',)
CARRIERS, QUICK_CARRIERS = ('smooth', 'brisk', 'stops'), ('smooth',)
TRAJECTORY, DURATION, QUICK_DURATION, QUICK_HALL = 't2', 10.0, 4.0, 7.0
MOVED = 0.005, 1.0  # m, deg: a fixed base that is so far off has moved
DRAWS, QUICK_DRAWS = 100, 1
Row = dict[str, Any]


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Run all parts and judge them."""
    trials = carried_trials(quick, seed)
    failed = record_bags([*trials, *start_trials(seed)], out, jobs)
    todo = [(bag_of(out, trial), trial) for trial in trials if trial.recording not in failed]
    done = show_progress(parallel(followed, todo, jobs), len(todo), 'estimating')
    carried = [carried_row(one) for one in done]
    hall = hall_rows([seed], QUICK_HALL) if quick else hall_rows(range(seed, seed + 4))
    starts = start_rows(out, quick, seed, jobs)
    tables = {'carried': carried, 'hall': hall, 'starts': starts}
    claims = [
        *carried_claims(carried),
        *hall_claims(hall),
        *start_claims(starts),
        at_most('trials that failed', len(failed), '', 0),
    ]
    write_study(
        out,
        claims,
        seed=seed,
        settings={'trials': trials},
        tables=tables,
        extra={'quick': quick, 'failed': failed},
    )
    write_study_report(out, 'The base is anywhere', claims, tables, ())
    return claims


# ------------------------------------------------------------------------- the engine, carried


def carried_trials(quick: bool, seed: int) -> list[Trial]:
    """List each scene and carrier, with all that the description may say of the base."""
    duration = QUICK_DURATION if quick else DURATION
    return [
        Trial(
            'engine',
            scene,
            TRAJECTORY,
            map_scene='S0',
            seed=seed,
            duration=duration,
            carried=carrier,
            told='odometry' if base == 'odometry' else 'arm',
            base=base,
        )
        for scene in (QUICK_SCENES if quick else SCENES)
        for carrier in (QUICK_CARRIERS if quick else CARRIERS)
        for base in ('measured', 'untold latency', 'odometry', 'free', 'fixed')
    ]


def carried_row(one: Followed) -> Row:
    """Errors of the worst ring and of the base, honesty, and what was told."""
    cm, deg = 100.0 * one.position.mean(axis=0), one.rotation_deg.mean(axis=0)
    return {
        'scene': one.trial.scene,
        'carried': one.trial.carried,
        'said to be': one.trial.base,
        'worst ring [cm]': cm[1:].max(),
        'worst ring [deg]': deg[1:].max(),
        'base [cm]': cm[0],
        'base [deg]': deg[0],
        'NEES/dof': one.nees[:, 1:].mean(),
        'ring, 99 % [cm]': 100.0 * np.percentile(one.position[:, 1:], 99),
        'frame [cm]': 100.0 * float(np.mean(one.frame_position)),
        'frame [deg]': float(np.mean(one.frame_rotation_deg)),
        'told after [s]': told_after(one),
        'doubtful [%]': 100.0 * float(np.mean(one.doubtful)),
    }


def told_after(one: Followed) -> float:
    """Time [s] from when a base has moved to when it is told; nan where either never is."""
    shift = np.linalg.norm(one.moved[:, :3], axis=1) > MOVED[0]
    turn = np.degrees(np.linalg.norm(one.moved[:, 3:], axis=1)) > MOVED[1]
    moved, told = np.flatnonzero(shift | turn), np.flatnonzero(one.doubtful)
    if one.trial.base != 'fixed' or not len(moved):
        return float('nan')
    return float(one.times[told[0]] - one.times[moved[0]]) if len(told) else float('inf')


def carried_claims(rows: Sequence[Row]) -> list[Claim]:
    """Ask of smooth, brisk and stopping motions what is asked of the base."""

    def of(base: str, column: str) -> np.ndarray:
        return np.array([row[column] for row in rows if row['said to be'] == base])

    claims = []
    for base, limit in (('measured', 0.12), ('odometry', 0.15), ('free', 0.15)):
        claims.append(
            at_most(f'{base}: worst ring', of(base, 'worst ring [cm]').max(), 'cm', limit)
        )
    claims += [
        at_most('measured: worst ring', of('measured', 'worst ring [deg]').max(), 'deg', 0.15),
        between('measured: NEES per dof', of('measured', 'NEES/dof').mean(), '', 0.7, 1.5),
        at_most('odometry: map -> odom', of('odometry', 'frame [cm]').max(), 'cm', 0.3),
        at_most('odometry: map -> odom', of('odometry', 'frame [deg]').max(), 'deg', 0.2),
        at_most('fixed: told after', of('fixed', 'told after [s]').max(), 's', 1.0),
        at_most('fixed: rings, 99 %', of('fixed', 'ring, 99 % [cm]').max(), 'cm', 0.3),
    ]
    return claims


# ---------------------------------------------------------------------------------- the Hall arm


def hall_claims(rows: Sequence[Row]) -> list[Claim]:
    """Compare an arm on a wrist with the same one that stands."""
    error = {
        name: np.mean([row['mean [mm]'] for row in rows if row['base'] == name])
        for name in ('stands', 'carried', 'carried, told exactly')
    }
    ratio = {name: value / error['stands'] for name, value in error.items()}
    return [
        at_most('Hall arm, carried over fixed', ratio['carried'], '', 1.5),
        at_most('Hall arm, told exactly, over fixed', ratio['carried, told exactly'], '', 1.5),
    ]


# ------------------------------------------------------------------------------ start from nothing


def start_trials(seed: int) -> list[Trial]:
    """List the recordings in which starts are drawn; the last is where a kidnapped robot wakes."""
    return [
        Trial('engine', 'S0', TRAJECTORY, seed=seed, duration=DURATION),
        Trial('soft_arm', 'R1', 'b2', seed=seed, duration=DURATION),
        Trial('engine', 'S0', TRAJECTORY, seed=seed, duration=DURATION, carried='smooth'),
    ]


def start_rows(out: Path, quick: bool, seed: int, jobs: int) -> list[Row]:
    """One row per case: how many of the draws were found, and how."""
    draws = QUICK_DRAWS if quick else DRAWS
    engine, box, elsewhere = (bag_of(out, trial) for trial in start_trials(seed))
    bags = {'engine': (engine,), 'soft_arm': (box,)}
    todo: list[tuple] = [
        (case, bags[case[0]][0], seed + 1000 + draw)
        for case in START_CASES
        for draw in range(draws)
    ]
    found = list(show_progress(parallel(started, todo, jobs), len(todo), 'starting'))
    moved = [(engine, elsewhere, seed + 1000 + draw) for draw in range(draws)]
    woken = list(show_progress(parallel(kidnap, moved, jobs), len(moved), 'kidnapping'))
    return [_summed(group) for group in _grouped([*found, *woken])]


def _grouped(results: Iterable[Row]) -> Iterator[list[Row]]:
    groups: dict[str, list[Row]] = {}
    for one in results:
        groups.setdefault(one['case'], []).append(one)
    yield from groups.values()


def _summed(group: list[Row]) -> Row:
    """Count the draws of a case."""
    found = [one for one in group if one['found']]
    middle = {
        f'{name}, median': np.median([one[name] for one in found]) if found else float('nan')
        for name in ('data [s]', 'computing [s]', 'error [cm]')
    }
    noticed = [one['noticed [s]'] for one in group if 'noticed [s]' in one]
    return {
        'case': group[0]['case'],
        'draws': len(group),
        'found [%]': 100.0 * len(found) / len(group),
        'wrong': sum(one['wrong'] for one in group),
        **middle,
        'data [s], most': max((one['data [s]'] for one in found), default=float('nan')),
        'computing [s], most': max((one['computing [s]'] for one in found), default=float('nan')),
        'noticed [s], most': max(noticed, default=float('nan')),
    }


def start_claims(rows: Sequence[Row]) -> list[Claim]:
    """Ask that starts are found, in time, and that nothing wrong is told."""
    claims = []
    for row in rows:
        name, least = row['case'], 80.0 if 'anywhere' in row['case'] else 95.0
        claims += [
            at_least(f'{name}: found', row['found [%]'], '%', least),
            at_most(f'{name}: wrong answers', row['wrong'], '', 0),
        ]
        if 'within' in name:
            claims += [
                at_most(f'{name}: data, most', row['data [s], most'], 's', 5.0),
                at_most(f'{name}: computing, median', row['computing [s], median'], 's', 3.0),
            ]
        if 'kidnapped' in name:
            claims.append(at_most(f'{name}: noticed after', row['noticed [s], most'], 's', 0.5))
    return claims
