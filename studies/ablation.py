"""What each sensor and part of the filter is worth on the engine; cold starts without strain."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
from continuum_loc.offline.trials import Trial
import numpy as np
from studies._filter_runs import (
    Case,
    CaseResult,
    failures,
    longest_unannounced,
    run_cases,
    settled_since,
)
from studies._pages import write_page
from studies.support.split import HOLD_OUT, require_unseen
from studies.support.worlds import by_world, column, in_worlds, told

NO_STRAIN = {'strain': {'enabled': False}}
NO_GYRO = {'gyro': {'enabled': False}}
NO_TOF = {'tof': {'enabled': False}}
NO_RECOVERY = {'recovery': {'enabled': False}}
NEVER = 1e6  # sigmas: a Cauchy loss of this scale is least squares

VARIANTS: dict[str, dict[str, Any]] = {
    'all sensors': {},
    'without strain': NO_STRAIN,
    'without strain, no recovery': NO_STRAIN | NO_RECOVERY,
    'without ToF': NO_TOF,
    'without gyro': NO_GYRO,
    'strain alone': NO_TOF | NO_GYRO,
    'ToF alone': NO_STRAIN | NO_GYRO,
    'ToF alone, no recovery': NO_STRAIN | NO_GYRO | NO_RECOVERY,
    'without planarity weight': {'tof': {'planarity_power': 0.0}},
    'without robust loss': {
        'tof': {'cauchy': NEVER},
        'gyro': {'cauchy': NEVER},
        'strain': {'cauchy': NEVER},
    },
    'gyro without robust loss': {'gyro': {'cauchy': NEVER}},
    'window 0.5 s': {'window': 0.5},
    'window 1 s': {'window': 1.0},
    'window 2 s': {'window': 2.0},
}
AGAINST_THE_MAP = (
    'all sensors',
    'without strain',
    'without planarity weight',
    'without robust loss',
)
QUICK = ('all sensors', 'without strain', 'without ToF')
COLD = {'cold': NO_STRAIN, 'cold, no recovery': NO_STRAIN | NO_RECOVERY}
COLD_STARTS = (5.0, 9.0, 12.0, 15.0)  # s into a trial, when the robot is bent
COLD_LENGTH = 3.0  # s
FOUND = 0.02  # m: with every ring closer than this a cold start has found itself
UNANNOUNCED = 1.0  # s: the limit for a ring that is off without a word

TEXT = """
The paper says of its strain sensor alone that it "does not provide enough information for accurate
localization, resulting in 'spatial drift'": bending is measured, position is its integral, so that
the error grows from the base to the tip. The rows `without ToF` and `strain alone` of the first
table show it ring by ring; {drift}.

Of ToF without strain it says that its estimates "frequently converge to local minima", for which
it had no cure. A filter that tracks from a known straight start seldom meets one; one that starts
bent, with nothing known but its base, does. The table of cold starts shows each twice, with the
search for another body switched off and on: {minima}.

A ring counts as off beyond 5 cm, and *unannounced* is the longest time for which a ring is off
while the filter says `tracking`. The window of `all sensors` is 1 s; the row `window 1 s` repeats
it under its name.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Replay every variant over trials that no number was tuned on.

    `quick`: three over four seconds, one cold start.
    """
    cases = warm_cases(quick, seed) + cold_cases(quick, seed)
    require_unseen([case.trial for case in cases])
    results = run_cases(cases, out, jobs)
    warm = [result for result in results if result.case.name in VARIANTS]
    cold = [result for result in results if result.case.name in COLD]
    claims: list[Claim] = []
    tables: dict[str, list[dict[str, Any]]] = {}
    for world, members in by_world(results, lambda one: one.case.trial).items():
        ours = set(map(id, members))
        begun, bent = ([one for one in kind if id(one) in ours] for kind in (warm, cold))
        claims += told(judge(begun, bent), world)
        for name, rows in tables_of(begun, bent).items():
            tables[name] = tables.get(name, []) + column(rows, world)
    write_study(
        out,
        claims,
        seed=seed,
        settings={'cases': cases},
        tables=tables,
        extra={'quick': quick, 'hold_out': HOLD_OUT['engine'], 'failed': failures(results)},
    )
    write_page(
        out,
        'Ablation: the engine robot',
        TEXT.format(drift=drift(warm), minima=minima(cold)),
        claims,
        {
            'By variant': tables['ablation'],
            'By variant, in a scene that differs from its map': tables['ablation_changed_scene'],
            'Cold starts': tables['cold_starts'],
        },
    )
    return claims


def tables_of(
    warm: Sequence[CaseResult], cold: Sequence[CaseResult]
) -> dict[str, list[dict[str, Any]]]:
    """Tabulate the variants by whether the map is the scene's own, the trials, the cold starts."""
    return {
        'ablation': variant_rows([result for result in warm if as_mapped(result)]),
        'ablation_changed_scene': variant_rows(
            [result for result in warm if not as_mapped(result)]
        ),
        'ablation_trials': [trial_row(result) for result in warm if result.run],
        'cold_starts': [cold_row(result) for result in cold if result.run],
    }


def warm_cases(quick: bool, seed: int) -> list[Case]:
    """
    Every variant from the start of two trials.

    And those that bear on it in a scene that differs from its map.
    """
    if quick:
        return [
            Case(name, trial, VARIANTS[name], end=4.0)
            for trial in in_worlds([Trial(trajectory='t2', seed=seed, duration=6.0)])
            for name in QUICK
        ]
    changed = Trial(scene='S9', trajectory='t2', map_scene='S0', seed=seed)
    trials = [Trial(trajectory='t2', seed=seed), Trial(trajectory='t3', seed=seed)]
    return [
        Case(name, trial, changes)
        for name, changes in VARIANTS.items()
        for trial in in_worlds([*trials, *[changed] * (name in AGAINST_THE_MAP)])
    ]


def cold_cases(quick: bool, seed: int) -> list[Case]:
    """Start in mid-recording, bent and moving, with nothing known but the base."""
    if quick:
        return [
            Case('cold', trial, COLD['cold'], start=4.6)
            for trial in in_worlds([Trial(trajectory='t2', seed=seed, duration=6.0)])
        ]
    trials = [Trial(trajectory=name, seed=seed) for name in ('t2', 't3')]
    return [
        Case(name, trial, changes, start, start + COLD_LENGTH)
        for name, changes in COLD.items()
        for trial in in_worlds(trials)
        for start in COLD_STARTS
    ]


def by_name(results: Sequence[CaseResult]) -> dict[str, list[CaseResult]]:
    """Sort the cases that gave a run by variant."""
    found: dict[str, list[CaseResult]] = {}
    for result in results:
        if result.run is not None:
            found.setdefault(result.case.name, []).append(result)
    return found


def as_mapped(result: CaseResult) -> bool:
    """Whether the map is that of the scene."""
    return result.case.trial.map_scene in (None, result.case.trial.scene)


def judge(warm: Sequence[CaseResult], cold: Sequence[CaseResult]) -> list[Claim]:
    """Judge the bound for trials without strain; the paper's two claims are figures."""
    groups = by_name(warm) | by_name(cold)
    claims = [
        at_most(
            f'{name}: longest time a ring is off unannounced',
            max(longest_unannounced(result) for result in groups[name]),
            's',
            UNANNOUNCED,
        )
        for name in ('without strain', 'ToF alone', 'cold')
        if name in groups
    ]
    if 'cold' in groups:
        claims.append(
            at_least(
                'cold starts that have found themselves at the end',
                sum(found_after(result) < np.inf for result in groups['cold']),
                '',
                len(groups['cold']),
            )
        )
    if 'without ToF' in groups and 'all sensors' in groups:
        claims += drift_claims(groups)
    broken = sum(result.run is None for result in (*warm, *cold))
    return [*claims, at_most('cases that failed', broken, '', 0)]


def drift_claims(groups: dict[str, list[CaseResult]]) -> list[Claim]:
    """Without ToF the error grows along the body; with it the tip is several times better."""
    without, everything = (
        ring_errors([result for result in groups[name] if as_mapped(result)])
        for name in ('without ToF', 'all sensors')
    )
    return [
        at_least(
            "without ToF: tip MAE over the first ring's (drift along the body)",
            without[-1] / without[0],
            'ratio',
            2.0,
        ),
        at_least(
            'without ToF: tip MAE over that with all sensors',
            without[-1] / everything[-1],
            'ratio',
            1.5,
        ),
    ]


def ring_errors(results: Sequence[CaseResult]) -> np.ndarray:
    """(R,) mean translation error of each ring [m] over the trials."""
    return np.mean([result.found.translation_m[:, 1:].mean(axis=0) for result in results], axis=0)


def found_after(result: CaseResult) -> float:
    """Time [s] after which every ring stays nearer than FOUND; inf where that never happens."""
    return settled_since(result.times, result.worst_ring < FOUND)


def variant_rows(results: Sequence[CaseResult]) -> list[dict[str, Any]]:
    """One row per variant, all over the same trials."""
    return [variant_row(name, members) for name, members in by_name(results).items()]


def variant_row(name: str, results: Sequence[CaseResult]) -> dict[str, Any]:
    """One variant over its trials."""
    rings = 100.0 * ring_errors(results)
    status = np.concatenate([result.status for result in results])
    row = {
        'variant': name,
        **{f'ring {k} [cm]': value for k, value in enumerate(rings.tolist(), start=1)},
    }
    row['rotation [deg]'] = float(
        np.mean([result.found.rotation_deg[:, 1:].mean() for result in results])
    )
    row['worst [cm]'] = 100.0 * max(float(result.worst_ring.max()) for result in results)
    row['unannounced [s]'] = max(longest_unannounced(result) for result in results)
    row['said lost [%]'] = 100.0 * float(np.mean(status == 'lost'))
    row['NEES/dof'] = float(np.mean([result.run.summary['nees_per_dof'] for result in results]))
    row['step [ms]'] = float(
        np.mean([result.run.summary['step_ms']['mean'] for result in results])
    )
    return row


def trial_row(result: CaseResult) -> dict[str, Any]:
    """One trial of a variant."""
    trial = result.case.trial
    return {
        'variant': result.case.name,
        'scene': trial.scene,
        'trajectory': trial.trajectory,
        'translation MAE [cm]': 100.0 * float(result.found.translation_m[:, 1:].mean()),
        'tip MAE [cm]': 100.0 * float(result.found.translation_m[:, -1].mean()),
        'worst [cm]': 100.0 * float(result.worst_ring.max()),
        'unannounced [s]': longest_unannounced(result),
        'NEES/dof': result.run.summary['nees_per_dof'],
        'coverage': result.run.summary['coverage_95'],
    }


def cold_row(result: CaseResult) -> dict[str, Any]:
    """One cold start."""
    count = len(result.times)
    return {
        'start': result.case.name,
        'trajectory': result.case.trial.trajectory,
        'at [s]': result.case.start,
        'first error [cm]': 100.0 * float(result.worst_ring[0]),
        'found after [s]': found_after(result),
        'last error [cm]': 100.0 * float(result.worst_ring[-1]),
        'unannounced [s]': longest_unannounced(result),
        **{
            f'{name} [%]': 100.0 * float(np.sum(result.status == name)) / count
            for name in ('initialising', 'tracking', 'lost')
        },
    }


def drift(warm: Sequence[CaseResult]) -> str:
    """Put the paper's first claim in figures."""
    groups = by_name(warm)
    if 'without ToF' not in groups or 'all sensors' not in groups:
        return 'no figures, as the trials failed'
    without, everything = (
        100.0 * ring_errors([result for result in groups[name] if as_mapped(result)])
        for name in ('without ToF', 'all sensors')
    )
    return (
        f'without ToF it goes from {without[0]:.2f} cm at the first ring to {without[-1]:.2f} cm '
        f'at the tip, with all sensors from {everything[0]:.2f} cm to {everything[-1]:.2f} cm'
    )


def minima(cold: Sequence[CaseResult]) -> str:
    """Put the paper's second claim in figures."""
    told = []
    for name, members in by_name(cold).items():
        stuck = sum(found_after(result) == np.inf for result in members)
        worst = 100.0 * max(float(result.worst_ring[-1]) for result in members)
        told.append(
            f'`{name}` ends in a wrong body in {stuck} of {len(members)} starts (the worst by '
            f'{worst:.1f} cm), off unannounced for up to '
            f'{max(longest_unannounced(result) for result in members):.2f} s'
        )
    return '; '.join(told) or 'no figures, as the trials failed'
