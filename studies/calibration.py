"""
What a robot that is not as described costs, and what finding that out gives back.

The disturbed world, in the frame of the map that the estimator has. Each robot is localised with
its description taken for exact, with its constants estimated online, and after it was calibrated
on one other recording, without a reference and with the truth as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from continuum_loc.calibration.batch import calibrate, Calibration
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.mapping.map_files import load_map
from continuum_loc.measurements import Measurement, TruthSample
from continuum_loc.offline.calibrated import tolerances_left
from continuum_loc.offline.claims import at_most, between, Claim, write_study
from continuum_loc.offline.localise import make_filter, trial_settings
from continuum_loc.offline.metrics import COVERAGE_BOUND, Errors, errors
from continuum_loc.offline.parallel import parallel
from continuum_loc.offline.replay import replay
from continuum_loc.offline.scanned_maps import T_map_scene
from continuum_loc.offline.scene_maps import scene_map_file
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.offline.trial_runs import trial_map_file
from continuum_loc.offline.trials import simulate, Trial
from continuum_loc.robot import load_robot, RobotDescription
import numpy as np
from studies.support.split import require_unseen

WORLD = 'disturbed'
# Robot: scene, recording to calibrate on, recording to judge by.
SUBJECTS = {'engine': ('S0', 't3', 't2'), 'soft_arm': ('R1', 'b3', 'b2')}
# What is asked of each robot, and how: cm, deg.
BOUNDS = {
    ('engine', 'online'): (0.5, np.inf),
    ('engine', 'online, after 10 s'): (0.2, 0.3),
    ('engine', 'calibrated'): (0.15, 0.25),
    ('engine', 'calibrated by truth'): (0.1, 0.12),
    ('soft_arm', 'calibrated'): (0.25, 0.4),
    ('soft_arm', 'calibrated by truth'): (0.13, 0.15),
}
NEES, COVERAGE = (0.7, 1.5), (0.90, 0.98)
SEEDS, QUICK_SEEDS = 3, 1
DURATION, QUICK_DURATION = 20.0, 6.0
SETTLED = 10.0  # s


class Row(NamedTuple):
    """Figures of one robot, one way and one seed."""

    robot: str
    way: str
    seed: int
    cm: float
    deg: float
    nees: float
    inside: float


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Localise every robot in every way, and judge the means."""
    duration = QUICK_DURATION if quick else DURATION
    seeds = range(seed, seed + (QUICK_SEEDS if quick else SEEDS))
    robots = ('engine',) if quick else tuple(SUBJECTS)
    todo = [(robot, one, duration) for robot in robots for one in seeds]
    require_unseen([trials(*item)[1] for item in todo])
    rows = [row for found in parallel(_subject, todo, jobs) for row in found]
    claims = judge(rows)
    table = means(rows)
    write_study(
        out,
        claims,
        seed=seed,
        settings={'subjects': SUBJECTS, 'seeds': list(seeds), 'duration': duration},
        tables={'calibration': table, 'runs': [row._asdict() for row in rows]},
        extra={'quick': quick},
    )
    write_study_report(out, 'Calibration', claims, {'Calibration': table}, [])
    return claims


def trials(robot: str, seed: int, duration: float) -> tuple[Trial, Trial]:
    """Name the recordings to calibrate on and to judge by, of the same built robot."""
    scene, learn, judged = SUBJECTS[robot]
    return tuple(
        Trial(robot, scene, one, seed=seed, duration=duration, world=WORLD)
        for one in (learn, judged)
    )


def _subject(item: tuple[str, int, float]) -> list[Row]:
    """Localise one built robot in every way."""
    name, seed, duration = item
    learn, judged = trials(name, seed, duration)
    robot, settings = load_robot(name), trial_settings(judged)
    before, after = samples_in_map(learn), samples_in_map(judged)
    exact = _with(settings, enabled=False)
    ways = [('taken for exact', robot, exact), ('online', robot, settings)]
    prior_map = load_map(trial_map_file(learn))
    for way, reference in (('calibrated', 'none'), ('calibrated by truth', 'truth')):
        found = calibrate(robot, prior_map, [before], settings, reference)
        ways.append((way, as_found(found, settings), settings))
    rows = []
    for way, described, chosen in ways:
        one = localise(described, load_map(trial_map_file(judged)), chosen, after)
        rows.append(row_of(name, way, seed, one, 0.0))
        if way == 'online' and duration > SETTLED:
            rows.append(row_of(name, f'online, after {SETTLED:g} s', seed, one, SETTLED))
    return rows


def samples_in_map(trial: Trial) -> list[Measurement | TruthSample]:
    """Simulate a trial, with its truth in the frame of the map that the estimator has."""
    T = T_map_scene(load_map(scene_map_file(trial.scene)), trial.departures, trial.seed)
    return [
        replace(one, T_map_ring=T @ one.T_map_ring) if isinstance(one, TruthSample) else one
        for one in simulate(trial)
    ]


def as_found(found: Calibration, settings: EstimatorSettings) -> RobotDescription:
    """Describe the robot as `continuum-loc calibrate` writes it."""
    left = tolerances_left(found, settings.calibration.least)
    return found.robot.model_copy(update={'tolerances': left})


def localise(robot, prior_map, settings, samples) -> Errors:
    """Errors of a replay against its truth."""
    result = replay(samples, make_filter(robot, prior_map, settings))
    return errors(result.track, result.truth)


def row_of(robot: str, way: str, seed: int, found: Errors, start: float) -> Row:
    """Mean figures of all rings from `start` [s] on."""
    kept = (found.stamps - found.stamps[0]) * 1e-9 >= start
    return Row(
        robot,
        way,
        seed,
        100.0 * float(found.translation_m[kept, 1:].mean()),
        float(found.rotation_deg[kept, 1:].mean()),
        float(np.nanmean(found.nees[kept, 1:])) / 6.0,
        float(np.mean(found.nees[kept, 1:] <= COVERAGE_BOUND)),
    )


def _with(settings: EstimatorSettings, **changes: Any) -> EstimatorSettings:
    calibration = settings.calibration.model_copy(update=changes)
    return settings.model_copy(update={'calibration': calibration})


def means(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """One row per robot and way: means over seeds."""
    table = []
    for robot, way in dict.fromkeys((row.robot, row.way) for row in rows):
        own = [row for row in rows if (row.robot, row.way) == (robot, way)]
        table.append(
            {
                'robot': robot,
                'description': way,
                'cm': float(np.mean([row.cm for row in own])),
                'deg': float(np.mean([row.deg for row in own])),
                'NEES/dof': float(np.mean([row.nees for row in own])),
                'inside 95 % [%]': 100.0 * float(np.mean([row.inside for row in own])),
                'runs': len(own),
            }
        )
    return table


def judge(rows: Sequence[Row]) -> list[Claim]:
    """Ask of every way what BOUNDS say of it, and that its covariance is honest."""
    claims = []
    for row in means(rows):
        robot, way = row['robot'], row['description']
        if (robot, way) not in BOUNDS:
            continue
        cm, deg = BOUNDS[robot, way]
        claims.append(at_most(f'{robot}, {way}: translation MAE', row['cm'], 'cm', cm))
        if np.isfinite(deg):
            claims.append(at_most(f'{robot}, {way}: rotation MAE', row['deg'], 'deg', deg))
        claims.append(between(f'{robot}, {way}: NEES per dof', row['NEES/dof'], '', *NEES))
        if way == 'online':
            inside = 0.01 * row['inside 95 % [%]']
            claims.append(between(f'{robot}, {way}: coverage', inside, '', *COVERAGE))
    return claims
