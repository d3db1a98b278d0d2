"""Claims: figures beside the bounds that they have to keep, and the files that hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from continuum_loc.offline.as_json import versions, write_json


@dataclass(frozen=True)
class Claim:
    """One figure that a study is meant to show, with the bound it has to keep."""

    name: str
    value: float
    unit: str
    bound: str
    holds: bool


# A value that is not a number holds no bound: every comparison below is false for nan.
def at_most(name: str, value: float, unit: str, limit: float) -> Claim:
    """Claim value <= limit."""
    return Claim(name, float(value), unit, f'<= {limit:g}', bool(value <= limit))


def at_least(name: str, value: float, unit: str, limit: float) -> Claim:
    """Claim value >= limit."""
    return Claim(name, float(value), unit, f'>= {limit:g}', bool(value >= limit))


def between(name: str, value: float, unit: str, low: float, high: float) -> Claim:
    """Claim low <= value <= high."""
    return Claim(name, float(value), unit, f'{low:g} to {high:g}', bool(low <= value <= high))


def write_study(
    out: Path,
    claims: Sequence[Claim],
    *,
    seed: int,
    settings: Any = None,
    tables: Mapping[str, Any] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """
    Write `out/summary.json` and each table as CSV, JSON, Markdown and LaTeX.

    The summary holds claims, seed, versions and configuration.

    settings: the configuration of the study: pydantic settings, a dataclass or plain mappings of
    them.
    tables: by name, a pandas DataFrame or a list of rows (mappings).
    extra: further keys of the summary.
    Returns the path of the summary.
    """
    from continuum_loc.offline.tables import write_table

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    for name, table in (tables or {}).items():
        write_table(table, out / name)
    summary = {
        'claims': list(claims),
        'seed': seed,
        'versions': versions(),
        'configuration': settings,
        'tables': sorted(tables or {}),
        **(extra or {}),
    }
    path = out / 'summary.json'
    write_json(path, summary)
    return path
