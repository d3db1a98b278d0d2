"""
Benchmarks: ours beside what one would use instead, as ratios with spread.

The ratios of a quiet day are committed as the baseline of later runs. A benchmark NAME is a file
`bench/NAME.py` of the source tree with `run(quick: bool) ->
list[dict]`. Each row has `name`, `ours_s`, `peer`, `peer_s`, `ratio` (peer over ours, the median
over interleaved repeats) and `spread` (the ratio's quartiles); a row without a peer has None in
the last four. `side_by_side` and `alone` make such rows; `exponent` and `memory_bytes` are shown
where a row has them. An optional `BOUNDS` of the module, a
list of (text in the row's name, field, "at least" or "at most", limit), says what the rows are
meant to show, each judged on the worst row whose name holds the text.

Times are processor time of this process, on one core (`one_core`): what one would wait for on a
quiet machine, whoever else uses this one.
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
from time import process_time
import traceback
from types import ModuleType
from typing import Any

from continuum_loc.errors import StudyError
from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
import numpy as np

BENCH_FOLDER = Path(__file__).parent
BASELINE = BENCH_FOLDER / 'baseline.json'
DOCUMENT = BENCH_FOLDER.parent / 'docs' / 'speed.md'
SHORTEST = 5e-3  # [s] that an action is timed for, by as many calls as that takes
# A ratio may fall by this share, or out of both runs' quartiles, whichever is more.
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


def side_by_side(
    name: str,
    ours: Callable[[], object],
    peer: str,
    theirs: Callable[[], object],
    repeats: int,
    per_call: int = 1,
    **more: Any,
) -> dict[str, Any]:
    """
    Row of two actions timed in turn, after one call each that is not counted.

    Every repeat takes the two in the other order, and each long enough for the clock.
    per_call: units of work in a call (the row states seconds per unit); more: further fields.
    """
    actions = (ours, theirs)
    calls = [_calls_worth_timing(action) for action in actions]
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for which in (0, 1) if k % 2 == 0 else (1, 0):
            times[k, which] = seconds_of(actions[which], calls[which]) / per_call
    return paired(name, peer, times, **more)


def paired(name: str, peer: str, times: np.ndarray, **more: Any) -> dict[str, Any]:
    """Row of interleaved times (repeats, 2) [s], ours and the peer's; more: further fields."""
    ratio = times[:, 1] / times[:, 0]
    return {
        'name': name,
        'ours_s': float(np.median(times[:, 0])),
        'peer': peer,
        'peer_s': float(np.median(times[:, 1])),
        'ratio': float(np.median(ratio)),
        'spread': [float(quartile) for quartile in np.quantile(ratio, [0.25, 0.75])],
        **more,
    }


def alone(name: str, seconds: float, **more: Any) -> dict[str, Any]:
    """Row of something that has no peer; more: further fields."""
    nobody = dict.fromkeys(('peer', 'peer_s', 'ratio', 'spread'))
    return {'name': name, 'ours_s': float(seconds), **nobody, **more}


def seconds_of(action: Callable[[], object], calls: int = 1) -> float:
    """Processor time of a call [s], the mean over so many."""
    started = process_time()
    for _ in range(calls):
        action()
    return (process_time() - started) / calls


def _calls_worth_timing(action: Callable[[], object]) -> int:
    action()  # may compile, allocate, or fill a cache
    return max(1, int(np.ceil(SHORTEST / max(seconds_of(action), 1e-9))))


@dataclass(frozen=True)
class BenchOutcome:
    """Rows of all benchmarks that ran, the claims on them, and the lines of those that failed."""

    rows: list[dict[str, Any]]
    claims: list[Claim]
    failures: list[str]

    def regressions(self, baseline: Path = BASELINE) -> list[str]:
        """List the ratios that fell clearly below the committed ones, a line for each."""
        known = read_baseline(baseline)
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


def bench_names(only: str | None = None) -> list[str]:
    """
    Names of the benchmarks in the source tree, or the one that is asked for.

    Raises StudyError where there is no source tree, or no such benchmark.
    """
    if not BENCH_FOLDER.is_dir():
        raise StudyError(
            f'{BENCH_FOLDER}: no benchmarks; they are in the source tree, '
            'not in the installed package'
        )
    names = sorted(
        path.stem
        for path in BENCH_FOLDER.glob('*.py')
        if not path.name.startswith('_') and path.stem != 'harness'
    )
    if only is not None and only not in names:
        raise StudyError(f"no benchmark '{only}'; benchmarks: {', '.join(names)}")
    return names if only is None else [only]


def install_peers() -> None:
    """Install the libraries that we are compared with, which nothing else needs."""
    wanted = BENCH_FOLDER / 'requirements.txt'
    pinned = BENCH_FOLDER.parent / 'requirements.txt'  # stays as it is, whatever a peer would like
    if wanted.is_file():
        files = ['-r', str(wanted), *(['-c', str(pinned)] if pinned.is_file() else [])]
        subprocess.run([sys.executable, '-m', 'pip', 'install', '--quiet', *files], check=True)


def run_bench(
    out: Path,
    quick: bool,
    only: str | None = None,
    each: Callable[[list[str], str], Iterable[str]] = lambda names, label: names,
) -> BenchOutcome:
    """
    Run one benchmark or all, and write the results to `out`.

    Files: `bench.json`, `.md`, `.csv`, `.tex` and `summary.json`; `NAME.traceback.txt` of a
    benchmark that failed, which does not stop the others.
    """
    names = bench_names(only)
    rows, claims, failures = [], [], []
    for name in each(names, 'measuring'):
        try:
            module = load_benchmark(name)
            measured = module.run(quick)
        except Exception:
            failures.append(_failure(name, out))
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


def _failure(name: str, out: Path) -> str:
    """Keep the traceback of the error being handled; a line that says what and where it is."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / f'{name}.traceback.txt'
    file.write_text(traceback.format_exc())
    error = sys.exc_info()[1]
    first = (str(error).strip().splitlines() or [''])[0]
    return f'{name}: {type(error).__name__}: {first} ({file})'


def load_benchmark(name: str) -> ModuleType:
    """Load a benchmark of the source tree as a module."""
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
            'exponent': '-' if row.get('exponent') is None else f'{row["exponent"]:.2f}',
            'memory': '-'
            if row.get('memory_bytes') is None
            else f'{row["memory_bytes"] / 1e6:.0f} MB',
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


def read_baseline(path: Path = BASELINE) -> dict[tuple[str, str], dict[str, Any]]:
    """Rows of a baseline by (name, peer). Raises StudyError where there is none."""
    if not path.is_file():
        raise StudyError(
            f'{path}: no baseline to compare with; write one by `continuum-loc bench --baseline`'
        )
    return {(row['name'], row['peer']): row for row in json.loads(path.read_text())}


def write_baseline(
    rows: list[dict[str, Any]], path: Path = BASELINE, partial: bool = False
) -> None:
    """Make these ratios the ones that later runs are compared with; `partial` keeps the others."""
    kept = read_baseline(path) if partial and path.is_file() else {}
    for row in rows:
        if row.get('ratio') is not None:
            short = {key: row[key] for key in ('name', 'peer')}
            kept[row['name'], row['peer']] = {
                **short,
                'ratio': float(f'{row["ratio"]:.4g}'),
                'spread': [float(f'{quartile:.4g}') for quartile in row['spread']],
            }
    path.write_text(json.dumps(list(kept.values()), indent=1) + '\n')


def write_document(rows: list[dict[str, Any]], path: Path = DOCUMENT) -> None:
    """
    Put the tables of the benchmarks that ran into the document, each between its two markers.

    Raises StudyError where a benchmark has no markers there.
    """
    text = path.read_text()
    for name in dict.fromkeys(row['benchmark'] for row in rows):
        head, tail = _around_table(text, name, path)
        text = head + markdown(table([row for row in rows if row['benchmark'] == name])) + tail
    path.write_text(text)


def require_places(names: Iterable[str], path: Path = DOCUMENT) -> None:
    """Raise StudyError where the document has no place for the table of a benchmark."""
    text = path.read_text()
    for name in names:
        _around_table(text, name, path)


def _around_table(text: str, name: str, path: Path) -> tuple[str, str]:
    """Text up to and with the marker before a benchmark's table, and from the one after it."""
    begin, end = f'<!-- bench {name} -->\n', f'<!-- end {name} -->'
    head, found, rest = text.partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise StudyError(f'{path}: no lines {begin.strip()} and {end} to put the table between')
    return head + begin, end + tail


def markdown(cells: list[dict[str, str]]) -> str:
    """Table of these rows, without the columns in which nobody has anything."""
    names = [name for name in cells[0] if any(row[name] != '-' for row in cells)]
    lines = [names, ['---'] * len(names), *([row[name] for name in names] for row in cells)]
    return ''.join(f'| {" | ".join(line)} |\n' for line in lines)
