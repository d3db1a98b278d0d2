"""
Tables of the localisation paper.

Mean and standard deviation over trials and rings, per condition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from continuum_loc.offline.parallel import Outcome
import numpy as np

# column -> (key of a run's figures, factor)
COLUMNS = {
    'translation MAE [cm]': ('translation_mae_m', 100.0),
    'translation RMSE [cm]': ('translation_rmse_m', 100.0),
    'rotation MAE [deg]': ('rotation_mae_deg', 1.0),
    'rotation RMSE [deg]': ('rotation_rmse_deg', 1.0),
}


def per_ring(outcomes: Iterable[Outcome], key: str, ring: str | None = None) -> np.ndarray:
    """Collect the figure `key` of each trial's rings (or of one), a value per trial and ring."""
    return np.array(
        [
            entry[key]
            for outcome in outcomes
            if outcome.summary is not None
            for name, entry in outcome.summary['rings'].items()
            if ring in (None, name) and entry[key] is not None
        ],
        float,
    )


def condition_table(
    outcomes: Sequence[Outcome],
    label: str,
    group: Callable[[Outcome], str],
    paper: dict[str, tuple[str, ...]],
) -> list[dict[str, Any]]:
    """
    One row per group in order of appearance.

    Each of COLUMNS as `mean ± deviation`, and the paper's beside it.
    """
    rows = []
    for name in dict.fromkeys(group(outcome) for outcome in outcomes):
        members = [outcome for outcome in outcomes if group(outcome) == name]
        row = {label: name, **figures(members)}
        row |= {
            f'paper: {column}': value
            for column, value in zip(COLUMNS, paper.get(name, ()), strict=False)
        }
        failed = sum(outcome.summary is None for outcome in members)
        rows.append(
            {
                **row,
                'trials': len(members) - failed,
                'failed': failed,
                'lost [%]': lost_share(members),
                'silent [s]': max(
                    (one.summary['silent_seconds'] for one in members if one.summary is not None),
                    default=float('nan'),
                ),
            }
        )
    return rows


def figures(outcomes: Sequence[Outcome], ring: str | None = None) -> dict[str, str]:
    """Each of COLUMNS as `mean ± standard deviation` over trials and rings."""
    cells = {}
    for column, (key, factor) in COLUMNS.items():
        values = factor * per_ring(outcomes, key, ring)
        cells[column] = f'{values.mean():.2f} ± {values.std():.2f}' if len(values) else '-'
    return cells


def lost_share(outcomes: Sequence[Outcome]) -> float:
    """Share of the estimates [%] at which the filter said that it was lost."""
    counts = [outcome.summary['estimates'] for outcome in outcomes if outcome.summary is not None]
    total = sum(count['all'] for count in counts)
    return (
        round(100.0 * sum(count['lost'] for count in counts) / total, 2) if total else float('nan')
    )


def trial_rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per simulated trial and ring: the data behind the tables."""
    return ring_rows(
        outcomes,
        lambda trial: {
            'map': trial.map_scene or trial.scene,
            'scene': trial.scene,
            'trajectory': trial.trajectory,
            'fidelity': trial.fidelity,
            'disturbed': trial.disturbed,
            'seed': trial.seed,
        },
    )


def ring_rows(
    outcomes: Sequence[Outcome], about: Callable[[Any], dict[str, Any]]
) -> list[dict[str, Any]]:
    """One row per trial and ring, begun by what is to be said `about` the trial."""
    keys = [key for key, _ in COLUMNS.values()] + [
        'translation_max_m',
        'nees_per_dof',
        'coverage_95',
    ]
    rows = []
    for outcome in outcomes:
        said = about(outcome.trial)
        if outcome.summary is None:
            rows.append({**said, 'ring': '', **dict.fromkeys(keys), 'error': outcome.error})
            continue
        rows += [
            {**said, 'ring': ring, **{key: entry[key] for key in keys}, 'error': ''}
            for ring, entry in outcome.summary['rings'].items()
        ]
    return rows


def mean(outcomes: Sequence[Outcome], key: str, factor: float = 1.0) -> float:
    """
    Mean of a figure over trials and rings; nan where there is none, or where a trial failed.

    A campaign that lost a trial proves nothing about its mean.
    """
    values = per_ring(outcomes, key)
    complete = len(values) and all(outcome.summary is not None for outcome in outcomes)
    return factor * float(values.mean()) if complete else float('nan')
