"""
Table III of the localisation paper: the soft arm in the box.

Map and scene are equal or one object apart.
"""

from __future__ import annotations

from pathlib import Path

from continuum_loc.offline.claims import at_most, Claim, write_study
from continuum_loc.offline.error_tables import condition_table, mean, trial_rows
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.offline.trials import GYRO_BIAS, MOUNTING_ERROR, TOF_CLOCK_OFFSET
from studies._paper_figures import side_by_side
from studies._soft_arm import (
    ADDED,
    condition,
    conditions,
    MATCHING,
    pair,
    REMOVED,
    soft_arm_trials,
)
from studies.support.campaign import Outcome, run_campaign
from studies.support.split import HOLD_OUT, is_hold_out, require_unseen

PAPER = {
    'R0 - R0': ('1.8 ± 0.6', '1.9 ± 0.7', '5.2 ± 1.4', '5.8 ± 1.8'),
    'R1 - R1': ('1.9 ± 0.9', '2.3 ± 1.3', '6.3 ± 4.3', '7.8 ± 6.0'),
    'R2 - R2': ('2.0 ± 1.0', '2.4 ± 1.3', '6.3 ± 3.9', '7.9 ± 5.5'),
    'R3 - R3': ('1.7 ± 0.8', '1.9 ± 1.0', '5.9 ± 2.6', '6.8 ± 3.7'),
    'R4 - R4': ('1.9 ± 0.4', '2.0 ± 0.4', '8.4 ± 5.0', '9.1 ± 5.1'),
    'R0 - R1': ('3.2 ± 2.0', '3.5 ± 2.1', '8.6 ± 6.6', '9.7 ± 7.3'),
    'R1 - R2': ('2.6 ± 1.8', '3.0 ± 2.3', '7.3 ± 5.3', '9.0 ± 7.3'),
    'R2 - R3': ('3.2 ± 2.2', '3.5 ± 2.2', '7.0 ± 3.2', '8.0 ± 4.1'),
    'R3 - R4': ('5.1 ± 2.1', '5.3 ± 2.1', '6.5 ± 4.3', '7.6 ± 5.8'),
    'R1 - R0': ('1.7 ± 0.6', '1.9 ± 0.7', '4.3 ± 1.5', '4.9 ± 2.1'),
    'R2 - R1': ('2.0 ± 1.0', '2.4 ± 1.4', '6.4 ± 4.4', '7.8 ± 6.1'),
    'R3 - R2': ('2.0 ± 1.0', '2.4 ± 1.3', '6.4 ± 3.8', '7.9 ± 5.4'),
    'R4 - R3': ('3.6 ± 2.6', '4.0 ± 2.9', '14.6 ± 4.0', '16.8 ± 5.3'),
}
LIMITS = {
    'paper': (0.3, 0.5),
    'vl53l5cx': (0.9, 2.6),
    'disturbed': (0.9, 2.6),
}  # cm, deg, matching maps
SILENT_LIMIT = 1.0  # s
WORSE = 0.5  # cm by which a row of another map may be worse than the scene's own


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Run all combinations in every condition and judge them."""
    outcomes = run_campaign(soft_arm_trials(quick, seed), out, jobs)
    claims = judge(outcomes)
    tables = {
        f'table3_{fidelity}': condition_table(
            of_fidelity(outcomes, fidelity), 'map - scene', row_name, PAPER
        )
        for fidelity in conditions()
    }
    write_study(
        out,
        claims,
        seed=seed,
        tables={**tables, 'trials': trial_rows(outcomes)},
        settings={
            'trials': [outcome.trial for outcome in outcomes],
            'mounting_error': MOUNTING_ERROR,
            'gyro_bias': GYRO_BIAS,
            'tof_clock_offset': TOF_CLOCK_OFFSET,
        },
        extra={
            'quick': quick,
            'hold_out': HOLD_OUT['soft_arm'],
            'failed': {outcome.trial.name: outcome.error for outcome in outcomes if outcome.error},
        },
    )
    write_study_report(
        out,
        'Table III: the soft arm',
        claims,
        {f'Errors, sensors as {name}': tables[f'table3_{name}'] for name in conditions()},
        outcomes,
        pictures=side_by_side(out, outcomes),
    )
    return claims


def row_name(outcome: Outcome) -> str:
    """Name the row of the table that a trial belongs to."""
    return ' - '.join(pair(outcome.trial))


def of_fidelity(outcomes: list[Outcome], fidelity: str) -> list[Outcome]:
    """Keep the trials of one condition."""
    return [outcome for outcome in outcomes if condition(outcome.trial) == fidelity]


def judged(outcomes: list[Outcome]) -> list[Outcome]:
    """Select what claims may rest on: all but the hold-out that the filter was tuned on."""
    unseen = [outcome for outcome in outcomes if not is_hold_out(outcome.trial)]
    require_unseen([outcome.trial for outcome in unseen])
    return unseen


def judge(outcomes: list[Outcome]) -> list[Claim]:
    """Judge the bounds, without the hold-out that the filter was tuned on."""
    claims = []
    for fidelity in dict.fromkeys(condition(outcome.trial) for outcome in outcomes):
        translation, rotation = LIMITS[fidelity]
        rows: dict[tuple[str, str], list[Outcome]] = {}
        for outcome in of_fidelity(judged(outcomes), fidelity):
            rows.setdefault(pair(outcome.trial), []).append(outcome)
        matching = [outcome for key in MATCHING for outcome in rows.get(key, [])]
        claims += [
            at_most(
                f'{fidelity}, matching maps: translation MAE',
                mean(matching, 'translation_mae_m', 100.0),
                'cm',
                translation,
            ),
            at_most(
                f'{fidelity}, matching maps: rotation MAE',
                mean(matching, 'rotation_mae_deg'),
                'deg',
                rotation,
            ),
        ]
        claims += _against_matching(fidelity, rows)
        claims.append(
            at_most(
                f'{fidelity}: trials off by more than 5 cm for over a second, not saying lost',
                sum(silently_lost(outcome) for outcome in of_fidelity(outcomes, fidelity)),
                '',
                0,
            )
        )
    return [
        *claims,
        at_most('trials that failed', sum(outcome.summary is None for outcome in outcomes), '', 0),
    ]


def _against_matching(fidelity: str, rows: dict[tuple[str, str], list[Outcome]]) -> list[Claim]:
    """Each row whose map differs, against the row of the same scene with its own map."""
    claims = []
    for map_scene, scene in ADDED + REMOVED:
        other, own = rows.get((map_scene, scene)), rows.get((scene, scene))
        if other and own:
            worse = mean(other, 'translation_mae_m', 100.0) - mean(own, 'translation_mae_m', 100.0)
            claims.append(
                at_most(
                    f'{fidelity}, {map_scene} - {scene}: worse than {scene} - {scene} by',
                    worse,
                    'cm',
                    WORSE,
                )
            )
    return claims


def silently_lost(outcome: Outcome) -> bool:
    """Whether a ring was 5 cm off for over a second on end and the filter did not say lost."""
    return outcome.summary is not None and outcome.summary['silent_seconds'] > SILENT_LIMIT
