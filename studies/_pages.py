"""The page of a study: what it is about, its claims and its tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from continuum_loc.offline.claims import Claim
from continuum_loc.offline.tables import markdown


def write_page(
    out: Path,
    title: str,
    text: str,
    claims: Sequence[Claim],
    tables: dict[str, Sequence[dict[str, Any]]],
) -> Path:
    """Write `out/study.md`: the explanation, the claims (those that fail first) and the tables."""
    import pandas as pd

    rows = [
        {
            'claim': claim.name,
            'value': f'{claim.value:.4g} {claim.unit}'.strip(),
            'bound': claim.bound,
            'holds': claim.holds,
        }
        for claim in sorted(claims, key=lambda claim: claim.holds)
    ]
    parts = [f'# {title}', text, '## Claims', markdown(pd.DataFrame(rows))]
    for name, table in tables.items():
        if not table:
            continue
        parts += [f'## {name}', markdown(pd.DataFrame(list(table)))]
    path = out / 'study.md'
    path.write_text('\n\n'.join(part.rstrip() for part in parts) + '\n')
    return path
