"""
Faults put into recordings.

How far the filter is led astray, how soon it is back, and whether it names the culprit.

A fault lasts from START for LENGTH seconds. Each case is judged beside the same trial without it:
*normal* is the largest error of that clean run over the same time, with a margin of a quarter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
from continuum_loc.offline.trials import Trial
from continuum_loc.robot import load_robot
from continuum_loc.simulator.faults import ClockOffset, Dropout, Fault, Freeze, Outliers
import numpy as np
from studies._filter_runs import (
    Case,
    CaseResult,
    failures,
    OFF,
    run_cases,
    settled_since,
)
from studies._pages import write_page
from studies._turned import Turned
from studies.support.split import require_unseen
from studies.support.worlds import by_world, column, in_worlds, told

START, LENGTH, AFTER = 8.0, 2.0, 3.0  # s
QUICK_START = 1.5  # s
BACK = 1.0  # s: the limit for being back to normal
NORMAL_MARGIN = 1.25
CLEAN = 'no fault'


@dataclass(frozen=True)
class Injected:
    """A kind of fault and whom it strikes."""

    name: str
    kind: type[Fault]
    sensors: tuple[str, ...]
    options: tuple[tuple[str, float], ...] = ()

    def at(self, start: float) -> Fault:
        """Make the fault as it strikes from `start` on."""
        return self.kind(
            sensors=self.sensors, start=start, end=start + LENGTH, **dict(self.options)
        )


INJECTED = (
    Injected('a ring silent', Dropout, ('ring3_*',)),
    Injected('ToF sensor stuck', Freeze, ('ring4_tof2',)),
    Injected('gyro stuck', Freeze, ('ring4_imu',)),
    Injected('30 % outliers on a ring', Outliers, ('ring4_tof*',), (('probability', 0.3),)),
    Injected('30 % outliers on all', Outliers, ('*',), (('probability', 0.3),)),
    Injected('sensor turned by 20 deg', Turned, ('ring5_tof1',)),
    Injected('ToF of a ring 50 ms late', ClockOffset, ('ring4_tof*',), (('offset', 0.05),)),
    Injected('gyro 50 ms late', ClockOffset, ('ring5_imu',), (('offset', 0.05),)),
)
QUICK = ('ToF sensor stuck', 'sensor turned by 20 deg')
EVERYBODY = ('*',)  # a fault of all sensors has no culprit to be told from the rest

TEXT = """
Each fault lasts 2 s. *During* is the largest error of any ring while it lasts, beside the same
trial without it; *back after* the time after its end from which on no ring is farther off than
normal (a quarter above the clean run's largest error). *Named* is the share of the culprits that
the diagnostics name while the fault lasts or within a second of its end: a sensor is named when it
is among `suspects`, or when it is missing from `inliers`, the shares of fitting samples of the
sensors that the window has heard. *Accused* are other sensors among the suspects. Whom the clean
run names over the same time does not count for either; that has a table and a claim of its own,
beside the least share of fitting samples of each kind of sensor.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Inject every fault into trials that no number was tuned on; `quick`: two faults into one."""
    cases = fault_cases(quick, seed)
    require_unseen([case.trial for case in cases])
    results = run_cases(cases, out, jobs)
    clean = {result.case.trial: result for result in results if result.case.name == CLEAN}
    claims, rows, healthy = [], [], []
    for world, members in by_world(results, lambda one: one.case.trial).items():
        found = [
            fault_row(result, clean[result.case.trial])
            for result in members
            if result.run and clean[result.case.trial].run and result.case.name != CLEAN
        ]
        whole = [
            clean_row(result) for result in members if result.case.name == CLEAN and result.run
        ]
        accused = sum(row['accused'] for row in whole)
        claims += told(
            [
                *judge(found, len(failures(members))),
                at_most('clean runs: sensors accused', accused, '', 0),
            ],
            world,
        )
        rows += column(found, world)
        healthy += column(whole, world)
    write_study(
        out,
        claims,
        seed=seed,
        settings={'cases': cases},
        tables={'faults': rows, 'no_fault': healthy},
        extra={'quick': quick, 'failed': failures(results)},
    )
    write_page(
        out, 'Faults', TEXT, claims, {'By fault and trial': rows, 'Without a fault': healthy}
    )
    return claims


def fault_cases(quick: bool, seed: int) -> list[Case]:
    """List the clean run and every fault, in each trial."""
    start = QUICK_START if quick else START
    trials = (
        [Trial(trajectory='t2', seed=seed, duration=6.0)]
        if quick
        else [Trial(trajectory=name, seed=seed) for name in ('t2', 't3')]
    )
    wanted = [one for one in INJECTED if one.name in QUICK or not quick]
    end = start + LENGTH + (1.5 if quick else AFTER)
    return [
        case
        for trial in in_worlds(trials)
        for case in (
            Case(CLEAN, trial, end=end),
            *(Case(one.name, trial, end=end, faults=(one.at(start),)) for one in wanted),
        )
    ]


def fault_row(result: CaseResult, clean: CaseResult) -> dict[str, Any]:
    """Tell what a fault did."""
    fault = result.case.faults[0]
    normal = NORMAL_MARGIN * float(clean.worst_ring[clean.times >= fault.start].max())
    during = (result.times >= fault.start) & (result.times < fault.end)
    after = result.times >= fault.end
    back = settled_since(result.times[after], result.worst_ring[after] <= normal) - fault.end
    return {
        'fault': result.case.name,
        'trajectory': result.case.trial.trajectory,
        'normal [cm]': 100.0 * normal,
        'during [cm]': 100.0 * float(result.worst_ring[during].max()),
        'back after [s]': max(back, 0.0),
        'lost [%]': 100.0 * float(np.mean(result.status[during] == 'lost')),
        **diagnosis(result, clean),
        'all struck': fault.sensors == EVERYBODY,
    }


def diagnosis(result: CaseResult, clean: CaseResult) -> dict[str, Any]:
    """Whom the filter names, and when, beyond those that it names without the fault too."""
    fault = result.case.faults[0]
    culprits = struck(fault)
    times = {
        name: named_at(result, fault, name)
        for name in culprits
        if np.isinf(named_at(clean, fault, name))
    }
    others = accused(result, fault) - culprits - accused(clean, fault)
    return {
        'named': sum(np.isfinite(time) for time in times.values()) / len(culprits),
        'named after [s]': max(times.values(), default=np.inf),
        'accused': len(others),
        'whom': ', '.join(sorted(others)) or '-',
    }


def clean_row(result: CaseResult) -> dict[str, Any]:
    """Tell who is accused in a run without a fault, and each kind's least fitting share."""
    blamed = set().union(*result.accused)
    least = {
        kind: min(
            share for shares in result.shares for name, share in shares.items() if kind in name
        )
        for kind in ('tof', 'imu')
    }
    return {
        'trajectory': result.case.trial.trajectory,
        'accused': len(blamed),
        'whom': ', '.join(sorted(blamed)) or '-',
        **{f'least share, {kind}': least[kind] for kind in least},
    }


def judge(rows: Sequence[dict[str, Any]], failed: int) -> list[Claim]:
    """Bounded error, recovery and diagnosis, fault by fault over the trials."""
    claims = []
    for name in dict.fromkeys(row['fault'] for row in rows):
        members = [row for row in rows if row['fault'] == name]
        claims += [
            at_most(
                f'{name}: largest error of a ring',
                max(row['during [cm]'] for row in members),
                'cm',
                100.0 * OFF,
            ),
            at_most(
                f'{name}: back to normal after',
                max(row['back after [s]'] for row in members),
                's',
                BACK,
            ),
        ]
        if not members[0]['all struck']:
            claims += [
                at_least(
                    f'{name}: share of culprits named',
                    min(row['named'] for row in members),
                    '',
                    1.0,
                ),
                at_most(f'{name}: others accused', max(row['accused'] for row in members), '', 0),
            ]
    return [*claims, at_most('cases that failed', failed, '', 0)]


def struck(fault: Fault) -> set[str]:
    """Find the engine's ToF sensors and gyros that a fault strikes."""
    robot = load_robot('engine')
    return {
        sensor.name
        for sensor in (*robot.tof, *robot.imu)
        if any(fnmatchcase(sensor.name, pattern) for pattern in fault.sensors)
    }


def noticed(result: CaseResult, fault: Fault) -> np.ndarray:
    """Find the steps at which a diagnosis can be due to the fault."""
    return np.flatnonzero((result.steps >= fault.start) & (result.steps < fault.end + BACK))


def accused(result: CaseResult, fault: Fault) -> set[str]:
    """All that the filter suspects at any such step."""
    return set().union(*(result.accused[step] for step in noticed(result, fault)))


def named_at(result: CaseResult, fault: Fault, name: str) -> float:
    """Time [s] from the fault's start until `name` is suspected or no longer heard, else inf."""
    steps = [
        step
        for step in noticed(result, fault)
        if name in result.accused[step] or name not in result.shares[step]
    ]
    return float(result.steps[steps[0]] - fault.start) if steps else float('inf')
