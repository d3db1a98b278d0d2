"""
Benchmarks: ours beside what one would use instead, as ratios with spread.

A baseline of ratios is committed.

A benchmark NAME is a file `bench/NAME.py` of the source tree with `run(quick: bool) ->
list[dict]`. Each row has `name`, `ours_s`, `peer`, `peer_s`, `ratio` (peer over ours, the median
over interleaved repeats) and `spread` (the ratio's quartiles); a row without a peer has None in
the last four. An optional `BOUNDS` of the module, a list of (text in the row's name, field, "at
least" or "at most", limit), says what the rows are meant to show, each judged on the worst row
whose name holds the text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import importlib.util
import json
import os
from pathlib import Path
import subprocess
import sys
import traceback
from types import ModuleType
from typing import Any

from continuum_loc.evaluation.study import at_least, at_most, Claim, write_study

BENCH_FOLDER = Path(__file__).parents[2] / 'bench'
BASELINE = BENCH_FOLDER / 'baseline.json'
# A ratio's fall counts beyond this share, or out of both runs' quartiles, whichever is more.
SLACK = 0.25


@contextmanager
def one_core() -> Iterator[None]:
    """Confine the process to one of its cores: libraries that would use threads share it."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


class BenchError(ValueError):
    """Benchmarks that are not there."""


@dataclass(frozen=True)
class BenchOutcome:
    """Rows of all benchmarks that ran, the claims on them, and the lines of those that failed."""

    rows: list[dict[str, Any]]
    claims: list[Claim]
    failures: list[str]

    def regressions(self, baseline: Path = BASELINE) -> list[str]:
        """List a line for each ratio that fell clearly below the committed one."""
        if not baseline.is_file():
            raise BenchError(
                f'{baseline}: no baseline to compare with; '
                'write one by `continuum-loc bench --baseline`'
            )
        known = {(row['name'], row['peer']): row for row in json.loads(baseline.read_text())}
        return [
            f'{row["name"]} against {row["peer"]}: ratio {row["ratio"]:.2f}, '
            f'baseline {old["ratio"]:.2f}'
            for row in self.rows
            if row.get('ratio') is not None
            and (old := known.get((row['name'], row['peer']))) is not None
            and _fell(row, old)
        ]


def _fell(row: dict[str, Any], old: dict[str, Any]) -> bool:
    return row['spread'][1] < old['spread'][0] and row['ratio'] < (1.0 - SLACK) * old['ratio']


def bench_names() -> list[str]:
    """
    Names of the benchmarks in the source tree.

    Raises BenchError where there is no source tree.
    """
    if not BENCH_FOLDER.is_dir():
        raise BenchError(
            f'{BENCH_FOLDER}: no benchmarks; they are in the source tree, '
            'not in the installed package'
        )
    return sorted(path.stem for path in BENCH_FOLDER.glob('*.py') if not path.name.startswith('_'))


def install_peers() -> None:
    """Install the libraries that we are compared with, which nothing else needs."""
    wanted = BENCH_FOLDER / 'requirements.txt'
    if wanted.is_file():
        subprocess.run(
            [sys.executable, '-m', 'pip', 'install', '--quiet', '-r', str(wanted)], check=True
        )


def run_bench(
    out: Path,
    quick: bool,
    only: str | None = None,
    each: Callable[[list[str], str], Iterable[str]] = lambda names, label: names,
) -> BenchOutcome:
    """
    Run one benchmark or all, and write the results to `out`.

    Files: `bench.json`, `.md`, `.csv`, `.tex` and `summary.json`.
    """
    names = bench_names()
    if only is not None and only not in names:
        raise BenchError(f"no benchmark '{only}'; benchmarks: {', '.join(names)}")
    rows, claims, failures = [], [], []
    for name in each([only] if only else names, 'measuring'):
        try:
            module = _load(name)
            measured = module.run(quick)
        except Exception:
            failures.append(f'{name}: {traceback.format_exc().strip().splitlines()[-1]}')
            continue
        rows += [{**row, 'benchmark': name} for row in measured]
        claims += bound_claims(measured, getattr(module, 'BOUNDS', ()))
    write_study(
        out,
        claims,
        seed=0,
        settings={'quick': quick, 'only': only},
        tables={'bench': table(rows)},
        extra={'rows': rows, 'failures': failures},
    )
    return BenchOutcome(rows, claims, failures)


def _load(name: str) -> ModuleType:
    path = BENCH_FOLDER / f'{name}.py'
    spec = importlib.util.spec_from_file_location(f'bench_{name}', path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def bound_claims(
    rows: list[dict[str, Any]], bounds: Iterable[tuple[str, str, str, float]]
) -> list[Claim]:
    """Judge the bounds that a benchmark states on its rows, each on its worst row."""
    claims = []
    for text, field, sense, limit in bounds:
        values = [row[field] for row in rows if text in row['name'] and row.get(field) is not None]
        unit = 'ratio' if field == 'ratio' else 's' if field.endswith('_s') else ''
        worst, judge = (max, at_most) if sense == 'at most' else (min, at_least)
        claims.append(
            judge(f'{text}: {field}', worst(values) if values else float('nan'), unit, limit)
        )
    return claims


def table(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Rows as one reads them."""
    return [
        {
            'what': row['name'],
            'ours': duration(row['ours_s']),
            'beside': row.get('peer') or '-',
            'theirs': duration(row.get('peer_s')),
            'ratio': '-' if row.get('ratio') is None else f'{row["ratio"]:.3g}',
            'quartiles': '-'
            if row.get('ratio') is None
            else '{:.3g} to {:.3g}'.format(*row['spread']),
        }
        for row in rows
    ]


def duration(seconds: float | None) -> str:
    """Seconds with a unit that suits them."""
    if seconds is None:
        return '-'
    for limit, factor, unit in ((1e-6, 1e9, 'ns'), (1e-3, 1e6, 'us'), (1.0, 1e3, 'ms')):
        if seconds < limit:
            return f'{seconds * factor:.3g} {unit}'
    return f'{seconds:.3g} s'


def write_baseline(rows: list[dict[str, Any]], path: Path = BASELINE) -> None:
    """Make these ratios the ones that later runs are compared with."""
    kept = [
        {key: row[key] for key in ('name', 'peer', 'ratio', 'spread')}
        for row in rows
        if row.get('ratio') is not None
    ]
    path.write_text(json.dumps(kept, indent=1) + '\n')
