"""
What people's files and wires do to the readers: a corpus of good, odd and damaged inputs.

Clouds, meshes, maps, settings, bags and lines of a driver, written by generators with fixed seeds.
Each is read in a process beside this one, and has one of four things that are right for it: its
values, an error, one of the two, or - where a damage cannot be told from data - that nothing
breaks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import tempfile
from typing import Any

from continuum_loc.offline.claims import at_least, at_most, Claim, write_study
from continuum_loc.offline.parallel import show_progress
from studies._input_case import (
    ACCEPTED,
    Case,
    CHANGED,
    CRASH,
    HANG,
    REFUSED_GOOD,
    Result,
    RIGHT,
    UNCLEAR,
)
from studies._input_worker import all_cases, Worker
from studies._pages import write_page

LEAST = 300  # inputs
MOST_MEMORY = 600  # MB that reading one of them may take: a bomb of 64 MB, and three copies of it
QUICK = 4  # every so many inputs
SILENT = (CHANGED, ACCEPTED)

TEXT = """
Each input is written by a generator with a fixed seed and read in a process of its own. *Changed
value* is a value read that was never written, or one missing of which nothing was said; *bad one
accepted* an input that should have been refused; *unclear error* one that does not name the file
in its first line. A cut table of text that does not say how many rows it has may end between two
of them; bytes that changed within numbers without a check sum cannot be told from data, and must
break nothing. Memory is what the process took while it read the input.
""".strip()


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """Read the corpus. `quick`: every fourth input of it."""
    cases = all_cases(seed)
    numbers = list(range(0, len(cases), QUICK if quick else 1))
    pairs = [(cases[number], result) for number, result in _results(numbers, seed, jobs)]
    claims = judge(pairs, quick)
    tables = {'kinds': kind_rows(pairs), 'wrong': wrong_rows(pairs), 'inputs': rows(pairs)}
    write_study(
        out,
        claims,
        seed=seed,
        tables=tables,
        extra={'quick': quick},
    )
    shown = {'By kind': tables['kinds'], 'What went wrong': tables['wrong']}
    write_page(out, 'Inputs', TEXT, claims, shown)
    return claims


def judge(pairs: Sequence[tuple[Case, Result]], quick: bool = False) -> list[Claim]:
    """No crash, no hang, nothing changed or accepted in silence, and good inputs read."""
    found = Counter(result.verdict for _, result in pairs)
    claims = [
        at_most('inputs that end the process or raise another error', found[CRASH], '', 0),
        at_most('inputs without an answer after 10 s', found[HANG], '', 0),
        at_most('changed values without a word', found[CHANGED], '', 0),
        at_most('bad inputs accepted', found[ACCEPTED], '', 0),
        at_most('good inputs refused', found[REFUSED_GOOD], '', 0),
        at_most('errors that do not name the input in a line', found[UNCLEAR], '', 0),
        at_most(
            'memory taken by one input',
            max((result.memory_mb for _, result in pairs), default=float('nan')),
            'MB',
            MOST_MEMORY,
        ),
    ]
    return claims if quick else [at_least('inputs', len(pairs), '', LEAST), *claims]


def _results(numbers: list[int], seed: int, jobs: int) -> Iterator[tuple[int, Result]]:
    """Yield (number of the case, its result), read by `jobs` processes."""
    shares = [numbers[job::jobs] for job in range(jobs)]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(jobs) as threads:
        work = [
            threads.submit(_share, share, seed, Path(folder) / str(job))
            for job, share in enumerate(shares)
        ]
        done = (pair for each in work for pair in each.result())
        yield from sorted(show_progress(done, len(numbers), 'reading'), key=lambda pair: pair[0])


def _share(numbers: list[int], seed: int, folder: Path) -> list[tuple[int, Result]]:
    worker = Worker(seed, folder)
    try:
        return [(number, worker.result(number)) for number in numbers]
    finally:
        worker.close()


def kind_rows(pairs: Sequence[tuple[Case, Result]]) -> list[dict[str, Any]]:
    """Count verdicts by kind of input."""
    found = []
    for kind in dict.fromkeys(case.kind for case, _ in pairs):
        results = [result for case, result in pairs if case.kind == kind]
        verdicts = Counter(result.verdict for result in results)
        found.append(
            {
                'kind': kind,
                'inputs': len(results),
                **{
                    verdict: verdicts[verdict]
                    for verdict in (RIGHT, CRASH, HANG, *SILENT, REFUSED_GOOD, UNCLEAR)
                },
                'longest [s]': max(result.seconds for result in results),
            }
        )
    return found


def rows(pairs: Sequence[tuple[Case, Result]]) -> list[dict[str, Any]]:
    """List every input with what became of it."""
    return [
        {
            'kind': case.kind,
            'input': case.name,
            'right': case.right,
            'verdict': result.verdict,
            'said': result.said,
            's': result.seconds,
            'MB': result.memory_mb,
        }
        for case, result in pairs
    ]


def wrong_rows(pairs: Sequence[tuple[Case, Result]]) -> list[dict[str, Any]]:
    """List those with which something is wrong."""
    return [row for row in rows(pairs) if row['verdict'] != RIGHT]
