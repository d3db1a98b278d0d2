"""
One self-contained HTML page about a campaign.

Its claims and tables, and its worst trial in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import Claim
from continuum_loc.offline.parallel import Outcome
from continuum_loc.offline.report import (
    context_of,
    number,
    Page,
    Part,
    render,
    Row,
    run_page,
    Table,
)
from continuum_loc.offline.runs import load_run

WORST_TRIALS = 12


def write_study_report(
    out: Path,
    title: str,
    claims: Sequence[Claim],
    tables: dict[str, list[dict[str, Any]]],
    outcomes: Sequence[Outcome],
    runs: Path | None = None,
    pictures: Sequence[Part] = (),
) -> Path:
    """
    Write `out/report.html`. The worst trial is the one with the greatest mean error.

    tables: by title, as rows. runs: the campaign's folder, by default `out`. pictures: shown below
    the tables.
    """
    ranked = sorted(
        (one for one in outcomes if one.summary is not None),
        key=lambda one: -(one.summary['translation_mae_m'] or 0.0),
    )
    failed = [one for one in outcomes if one.summary is None]
    held = sum(claim.holds for claim in claims)
    cards = [
        ('claims that hold', f'{held} of {len(claims)}'),
        ('trials', str(len(ranked))),
        ('failed trials', str(len(failed))),
    ]
    groups = [
        [claims_part(claims)],
        *([Part(name, table=as_table(rows))] for name, rows in tables.items()),
        *([picture] for picture in pictures),
        [worst_part(ranked)],
    ]
    if failed:
        groups.append(
            [
                Part(
                    'Failed trials',
                    table=as_table(
                        [{'trial': one.trial.name, 'error': one.error} for one in failed]
                    ),
                )
            ]
        )
    page = Page(title, f'{len(outcomes)} trials', cards, groups)
    path = out / 'report.html'
    path.write_text(render(with_worst_trial(page, runs or out, ranked)))
    return path


def with_worst_trial(page: Page, out: Path, ranked: Sequence[Outcome]) -> Page:
    """Make the page, followed by everything that the report of the worst trial shows."""
    if not ranked:
        return page
    run = load_run(out / 'trials' / ranked[0].trial.name)
    worst = run_page(run, context_of(run))
    judged = ranked[0].summary['translation_mae_m'] is not None
    head = Part(f'{"The worst trial" if judged else "One trial"}: {worst.title}', worst.subtitle)
    return replace(
        page, groups=[*page.groups, [head], *worst.groups], configuration=worst.configuration
    )


def claims_part(claims: Sequence[Claim]) -> Part:
    """Show the claims, those that fail first."""
    rows = [
        Row(
            [
                claim.name,
                f'{claim.value:.4g} {claim.unit}'.strip().replace(' ', '\u00a0'),
                claim.bound.replace('<=', '≤').replace('>=', '≥').replace(' ', '\u00a0'),
                'yes' if claim.holds else 'no',
            ]
        )
        for claim in sorted(claims, key=lambda claim: claim.holds)
    ]
    return Part('Claims', table=Table(['claim', 'value', 'bound', 'holds'], rows, words=(0, 2, 3)))


def worst_part(ranked: Sequence[Outcome]) -> Part:
    """Show the trials with the greatest mean error, the worst first; without truth, last."""
    rows = [
        Row(
            [
                one.trial.name,
                number(one.summary['translation_mae_m'], 100),
                number(one.summary['translation_max_m'], 100),
                number(one.summary['rotation_mae_deg']),
                f'{one.summary["estimates"]["lost"]} of {one.summary["estimates"]["all"]}',
            ]
        )
        for one in ranked[:WORST_TRIALS]
    ]
    return Part(
        'Worst trials first',
        'Each has a run folder under trials/; `continuum-loc report` makes its page.',
        Table(
            ['trial (map, robot, scene, trajectory)', 'MAE cm', 'max cm', 'MAE deg', 'said lost'],
            rows,
        ),
    )


def unbroken(value: Any) -> str:
    """Write a cell so that a mean and its deviation, a map and its scene stay on one line."""
    return str(value).replace(' ± ', '\u00a0±\u00a0').replace(' - ', '\u00a0-\u00a0')


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def as_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Rows of mappings with equal keys as a table of the page."""
    columns = list(rows[0]) if rows else []
    words = [index for index, name in enumerate(columns) if rows and not _is_number(rows[0][name])]
    return Table(
        columns,
        [Row([unbroken(row[name]) for name in columns]) for row in rows],
        words,
    )
