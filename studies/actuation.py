"""
Tendons as measurements: real robots identified, statics against references, what they are worth.

Real robots are public recordings, found through CONTINUUM_LOC_DATA: a folder that holds
`tendon_displacement/v4` and `v6` with `tendon_pull.csv` and `train.csv`. Their constants (lengths
of modules, distance of tendons) are the makers'; order, angles and the rest are found. Published
shapes of two rods are read from `sorosim/*_dataStatics.csv` in the same folder. What is not there
is left out, and said.

The simulated robots get a block `actuation` with what a maker knows of them; in the disturbed
world that block is wrong by 5 % of stiffness, 3 % of weight and 2 degrees of the tendons' angles.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_most, between, Claim, write_study
from continuum_loc.offline.identified import Identified, identify
from continuum_loc.offline.motor_csv import read_csv, together
from continuum_loc.offline.trials import Trial
from continuum_loc.settings import dump_settings
from continuum_loc.simulator.faults import Dropout
import numpy as np
from studies._filter_runs import Case, CaseResult, failures, run_cases
from studies._pages import write_page
from studies.ablation import NO_GYRO, NO_STRAIN, NO_TOF
from studies.support.actuated import ARM, REAL, real_robot, simulated_robot
from studies.support.pushed import Found, pushed
from studies.support.static_shapes import cosserat_errors, sorosim_errors
from studies.support.worlds import by_world, column, in_worlds, told

DATA = 'CONTINUUM_LOC_DATA'
ELEMENTS = 12
NO_TENDONS = {'mechanics': {'enabled': False}}
BLIND = ((6.0, 9.0), (12.0, 15.0))  # [s]
UNSEEN = tuple(
    Dropout(sensors=('*tof*',), start=start, end=end, seed=k)
    for k, (start, end) in enumerate(BLIND)
)
# Bounds: tip RMSE [mm] of the fit, and of patterns held out.
BOUNDS = {'v4': (8.5, 9.5), 'v6': (11.0, 13.0)}

# Robot, trajectory, where it is pushed [m] and how hard [N]; in free space, without ToF.
PUSHES = (
    ('engine', 't3', 1.5, 0.5),
    ('engine', 't3', 1.5, 1.0),
    ('engine', 't3', 1.2, 1.0),
    ('engine', 't3', 0.9, 2.0),
)

VARIANTS: dict[str, dict[str, Any]] = {
    'tendons alone': NO_TOF | NO_GYRO | NO_STRAIN,
    'tendons and gyro': NO_TOF | NO_STRAIN,
    'strain alone': NO_TOF | NO_GYRO | NO_TENDONS,
    'ToF and tendons': NO_GYRO | NO_STRAIN,
    'ToF alone': NO_GYRO | NO_STRAIN | NO_TENDONS,
    'blind 3 s, with tendons': {},
    'blind 3 s, without tendons': NO_TENDONS,
}

TEXT = """
Real robots: nine tendons each, of which nothing is known but the distance from the backbone and
where modules end. A static map of the same columns cannot do better than the hysteresis of the
recording; friction and delay are part of the fit.

Ablation: mean error of the tip. *Blind*: all ToF sensors are silent from 6 to 9 s and from 12 to
15 s; the figure is the mean over these stretches alone.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """`quick`: statics, and four seconds of one engine trial."""
    claims, shapes = statics(data_folder())
    found = {} if quick else identified(data_folder())
    claims += real_claims(found)
    pushes = [pushed(*push, seed + k) for k, push in enumerate(PUSHES[:1] if quick else PUSHES)]
    claims += load_claims(pushes)
    results = run_cases(cases(out, quick, seed), out, jobs)
    rows: list[dict[str, Any]] = []
    for world, members in by_world(results, lambda one: one.case.trial).items():
        claims += told(judge(members), world)
        rows += column([row(one) for one in members if one.run], world)
    tables = {
        'statics': shapes,
        'real_robots': real_rows(found),
        'ablation': rows,
        'loads': [one.row() for one in pushes],
    }
    for name, one in found.items():
        dump_settings(one.robot, out / f'{name}.yaml')
    extra = {'quick': quick, 'failed': failures(results), 'without': missing(data_folder())}
    write_study(
        out, claims, seed=seed, settings={'variants': VARIANTS}, tables=tables, extra=extra
    )
    titles = ('Statics', 'Real robots', 'What tendons are worth', 'Forces in free space')
    pages = dict(zip(titles, tables.values(), strict=True))
    write_page(out, 'Actuation', TEXT, claims, pages)
    return claims


def data_folder() -> Path | None:
    named = os.environ.get(DATA)
    return Path(named) if named else None


def missing(folder: Path | None) -> list[str]:
    """Name what is left out for want of data."""
    wanted = [*(f'tendon_displacement/{name}' for name in REAL), 'sorosim']
    return [name for name in wanted if folder is None or not (folder / name).is_dir()]


def statics(folder: Path | None) -> tuple[list[Claim], list[dict[str, Any]]]:
    """Tip errors at ELEMENTS elements [mm]: against the shooting solver, and published shapes."""
    errors = {'Cosserat equations by shooting': cosserat_errors(ELEMENTS)}
    if 'sorosim' not in missing(folder):
        errors |= sorosim_errors(folder / 'sorosim', ELEMENTS)
    rows = [
        {
            'reference': name,
            'shapes': len(found),
            'mean tip error [mm]': float(np.mean(found)),
            'worst [mm]': float(np.max(found)),
        }
        for name, found in errors.items()
    ]
    return [
        at_most(f'statics: {name}', row['mean tip error [mm]'], 'mm', 0.3)
        for name, row in zip(errors, rows, strict=True)
    ], rows


def identified(folder: Path | None) -> dict[str, Identified]:
    """Identify the real robots that there are."""
    found = {}
    for name in REAL:
        if f'tendon_displacement/{name}' in missing(folder):
            continue
        place = folder / 'tendon_displacement' / name
        recording = together([read_csv(place / f'{one}.csv') for one in ('tendon_pull', 'train')])
        found[name] = identify(real_robot(name), recording, ARM)
    return found


def real_claims(found: dict[str, Identified]) -> list[Claim]:
    claims = []
    for name, one in found.items():
        fit, held_out, nees = one.figures().values()
        claims += [
            at_most(f'{name}: tip RMSE of the fit', fit, 'mm', BOUNDS[name][0]),
            at_most(f'{name}: tip RMSE, patterns held out', held_out, 'mm', BOUNDS[name][1]),
            between(f'{name}: NEES/dof, patterns held out', nees, '', 0.7, 1.5),
        ]
    return claims


def load_claims(pushes: Sequence[Found]) -> list[Claim]:
    """Bounds of the forces that are told: the worst of all pushes."""
    return [
        at_most('loads: told in free space', sum(one.false for one in pushes), 'estimates', 0),
        at_most('loads: found after', max(one.after for one in pushes), 's', 0.3),
        at_most('loads: error of size', 100.0 * max(one.size for one in pushes), '%', 20.0),
        at_most('loads: error of place', 100.0 * max(one.place for one in pushes), 'cm', 5.0),
    ]


def real_rows(found: dict[str, Identified]) -> list[dict[str, Any]]:
    return [
        {'robot': name, **one.figures(), 'findings': '; '.join(one.findings)}
        for name, one in found.items()
    ]


def cases(out: Path, quick: bool, seed: int) -> list[Case]:
    """List the variants; those with ToF go over one trajectory of each robot."""
    if quick:
        trial = Trial(_described(out, 'engine', False), 'S0', 't2', seed=seed, duration=4.0)
        return [
            Case(name, trial, VARIANTS[name]) for name in ('tendons alone', 'tendons and gyro')
        ]
    made = []
    for robot, scene, paths in (('engine', 'S0', ('t2', 't3')), ('soft_arm', 'R1', ('b2',))):
        for name, changes in VARIANTS.items():
            sees = 'ToF' in name or 'blind' in name
            trials = [
                Trial(robot, scene, path, seed=seed) for path in paths[: 1 if sees else None]
            ]
            for trial in in_worlds(trials):
                if robot == 'soft_arm' and name == 'strain alone':
                    continue  # it has none
                file = _described(out, robot, trial.world != 'ideal')
                faults = UNSEEN if 'blind' in name else ()
                described = Trial(file, scene, trial.trajectory, seed=seed, world=trial.world)
                made.append(Case(name, described, changes, faults=faults))
    return made


def _described(out: Path, robot: str, wrong: bool) -> str:
    """Write a simulated robot's description with its block `actuation`; where it is."""
    file = out / 'robots' / f'{robot}{"_wrong" if wrong else ""}.yaml'
    file.parent.mkdir(parents=True, exist_ok=True)
    dump_settings(simulated_robot(robot, wrong), file)
    return str(file)


def tip_errors(result: CaseResult) -> np.ndarray:
    """Tip errors [m] of a case; of the blind stretches alone where there are any."""
    tip = result.found.translation_m[:, -1]
    if not result.case.faults:
        return tip
    return tip[np.any([(result.times > a) & (result.times < b) for a, b in BLIND], axis=0)]


def row(result: CaseResult) -> dict[str, Any]:
    trial, tip = result.case.trial, tip_errors(result)
    return {
        'robot': Path(trial.robot).stem.removesuffix('_wrong'),
        'trajectory': trial.trajectory,
        'variant': result.case.name,
        'tip [cm]': 100.0 * float(tip.mean()),
        'worst [cm]': 100.0 * float(tip.max()),
        'all rings [cm]': 100.0 * float(result.found.translation_m[:, 1:].mean()),
        'rotation [deg]': float(result.found.rotation_deg[:, 1:].mean()),
        'NEES/dof': result.run.summary['nees_per_dof'],
        'step [ms]': result.run.summary['step_ms']['mean'],
    }


def judge(results: Sequence[CaseResult]) -> list[Claim]:
    """Bounds of the tip's mean error on the engine."""
    claims = []
    for name, limit in (('tendons and gyro', 1.5), ('blind 3 s, with tendons', 0.5)):
        mine = [
            one
            for one in results
            if one.run and one.case.name == name and 'engine' in Path(one.case.trial.robot).stem
        ]
        if mine:
            tip = 100.0 * float(np.mean([tip_errors(one).mean() for one in mine]))
            claims.append(at_most(f'engine, {name}: tip', tip, 'cm', limit))
    return claims
