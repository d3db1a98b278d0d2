"""Tables of results as data (CSV, JSON) and as they are read (Markdown, LaTeX)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from continuum_loc.extras import require

if TYPE_CHECKING:
    import pandas as pd

LATEX_SPECIAL = str.maketrans(
    {
        '&': r'\&',
        '%': r'\%',
        '_': r'\_',
        '#': r'\#',
        '$': r'\$',
        '{': r'\{',
        '}': r'\}',
        '±': r'$\pm$',
        '≤': r'$\le$',
        '≥': r'$\ge$',
        '°': r'$^\circ$',
    }
)


def write_table(table: pd.DataFrame | Sequence[Mapping[str, Any]], stem: Path) -> None:
    """Write `stem`.csv, .json, .md and .tex. `table` is a DataFrame or a list of rows."""
    pd = require('pandas', 'report')

    frame = table if isinstance(table, pd.DataFrame) else pd.DataFrame(list(table))
    stem.parent.mkdir(parents=True, exist_ok=True)
    frame.to_csv(stem.with_suffix('.csv'), index=False)
    frame.to_json(stem.with_suffix('.json'), orient='records', indent=2, double_precision=15)
    stem.with_suffix('.md').write_text(markdown(frame))
    stem.with_suffix('.tex').write_text(latex(frame))


def markdown(frame: pd.DataFrame) -> str:
    """Write a GitHub table: text left, numbers right with four significant digits."""
    header = [str(name) for name in frame.columns]
    ruler = [
        '---:' if kind in 'iuf' else '---'
        for kind in (frame[name].dtype.kind for name in frame.columns)
    ]
    lines = [header, ruler, *_cells(frame)]
    return ''.join(
        '| ' + ' | '.join(cell.replace('|', r'\|') for cell in line) + ' |\n' for line in lines
    )


def latex(frame: pd.DataFrame) -> str:
    r"""Write a booktabs tabular, ready to be \\input."""
    columns = ''.join('r' if frame[name].dtype.kind in 'iuf' else 'l' for name in frame.columns)
    rows = [
        ' & '.join(cell.translate(LATEX_SPECIAL) for cell in line) + r' \\'
        for line in _cells(frame)
    ]
    head = ' & '.join(str(name).translate(LATEX_SPECIAL) for name in frame.columns) + r' \\'
    return '\n'.join(
        [
            rf'\begin{{tabular}}{{{columns}}}',
            r'\toprule',
            head,
            r'\midrule',
            *rows,
            r'\bottomrule',
            r'\end{tabular}',
            '',
        ]
    )


def _cells(frame: pd.DataFrame) -> list[list[str]]:
    return [[_cell(value) for value in row] for row in frame.itertuples(index=False, name=None)]


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return '-'
    if isinstance(value, bool):
        return 'yes' if value else 'no'
    return f'{value:.4g}' if isinstance(value, float) else str(value)
