"""Table IV of the localisation paper: the soft arm's rings, over all conditions of Table III."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import at_most, Claim, write_study
from continuum_loc.offline.error_tables import figures, per_ring, trial_rows
from continuum_loc.offline.study_report import write_study_report
from continuum_loc.robot import load_robot
from studies._soft_arm import conditions, soft_arm_trials
from studies.support.campaign import Outcome, run_campaign
from studies.support.split import HOLD_OUT
from studies.table3 import judged, of_fidelity

# Ring, base to tip: translation MAE (cm) and rotation MAE (deg) of the paper.
PAPER = (
    ('Top', 1.7, 1.3, 4.8, 4.1),
    ('Middle', 2.3, 1.2, 7.0, 3.4),
    ('Bottom (tip)', 3.6, 1.9, 9.9, 4.9),
)


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Judge the trials of Table III by ring, and write the results to `out/table4`.

    Trials that are in `out` already are not run again.
    """
    outcomes = run_campaign(soft_arm_trials(quick, seed), out, jobs)
    folder = out / 'table4'
    claims, tables = [], {}
    for fidelity in conditions():
        members = of_fidelity(outcomes, fidelity)
        tables[f'table4_{fidelity}'] = _rows(members)
        claims += _judge(judged(members), fidelity)
    claims.append(
        at_most('trials that failed', sum(outcome.summary is None for outcome in outcomes), '', 0)
    )
    write_study(
        folder,
        claims,
        seed=seed,
        settings={'trials': [outcome.trial for outcome in outcomes]},
        tables={**tables, 'trials': trial_rows(outcomes)},
        extra={'quick': quick, 'hold_out': HOLD_OUT['soft_arm']},
    )
    write_study_report(
        folder,
        'Table IV: the soft arm, ring by ring',
        claims,
        {f'Errors, sensors as {name}': tables[f'table4_{name}'] for name in conditions()},
        outcomes,
        runs=out,
    )
    return claims


def _rings() -> list[tuple[str, tuple]]:
    return list(zip(load_robot('soft_arm').ring_names, PAPER, strict=True))


def _rows(outcomes: list[Outcome]) -> list[dict[str, Any]]:
    rows = []
    for ring, (name, translation, spread, rotation, turn_spread) in _rings():
        rows.append(
            {
                'ring': name,
                **figures(outcomes, ring),
                'paper: translation MAE [cm]': f'{translation} ± {spread}',
                'paper: rotation MAE [deg]': f'{rotation} ± {turn_spread}',
            }
        )
    return rows


def _judge(outcomes: list[Outcome], fidelity: str) -> list[Claim]:
    """Every ring below the paper's."""
    claims = []
    for ring, (name, translation, _, rotation, _) in _rings():
        for kind, key, factor, unit, limit in (
            ('translation', 'translation_mae_m', 100.0, 'cm', translation),
            ('rotation', 'rotation_mae_deg', 1.0, 'deg', rotation),
        ):
            values = factor * per_ring(outcomes, key, ring)
            claims.append(
                at_most(
                    f'{fidelity}, {name}: {kind} MAE',
                    values.mean() if len(values) else float('nan'),
                    unit,
                    limit,
                )
            )
    return claims
