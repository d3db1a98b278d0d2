"""One input of the corpus: what it is, how it is read, and what is right for it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
import re
import resource
import time
from typing import Any

from continuum_loc.errors import InputError

# What is right for an input: its values; an error; its values or an error; or that nothing breaks,
# where a damage cannot be told from data.
READ, REFUSED, EITHER, ANYTHING = 'read', 'refused', 'either', 'anything'

RIGHT = 'right'
CRASH = 'crash'  # the process ended, or an error of another kind than for an input
HANG = 'hang'
CHANGED = 'changed value'
ACCEPTED = 'bad one accepted'
REFUSED_GOOD = 'good one refused'
UNCLEAR = 'unclear error'

MOST_LINES, LONGEST = 6, 600  # of an error: the command line prints it as it is


@dataclass(frozen=True)
class Case:
    """
    An input.

    write: makes it in an empty folder and returns what `read` is given. judge: what is wrong with
    the value read, empty where nothing is.
    """

    kind: str
    name: str
    write: Callable[[Path], Any]
    read: Callable[[Any], Any]
    right: str
    judge: Callable[[Any], str] = lambda value: ''


@dataclass(frozen=True)
class Result:
    """What became of a case: the verdict, what was said, seconds, and memory newly taken [MB]."""

    verdict: str
    said: str = ''
    seconds: float = 0.0
    memory_mb: float = 0.0


def attempt(case: Case, folder: Path) -> Result:
    """Make a case's input and read it."""
    given = case.write(folder)
    before, start = _forget_peak(), time.monotonic()
    try:
        value = case.read(given)
    except InputError as error:
        verdict, said = _of_error(case, str(error), given), str(error)
    except Exception as error:
        verdict, said = CRASH, f'{type(error).__name__}: {error}'[:LONGEST]
    else:
        verdict, said = _of_value(case, value)
    return Result(verdict, said, time.monotonic() - start, _peak_mb() - before)


def _of_error(case: Case, said: str, given: Any) -> str:
    if case.right == READ:
        return REFUSED_GOOD
    named = not isinstance(given, Path) or given.name in said
    lines = said.splitlines()
    short = 0 < len(lines) <= MOST_LINES and len(lines[0]) <= LONGEST
    return RIGHT if named and short else UNCLEAR


def _of_value(case: Case, value: Any) -> tuple[str, str]:
    if case.right == REFUSED:
        return ACCEPTED, f'gave {type(value).__name__}'
    wrong = '' if case.right == ANYTHING else case.judge(value)
    return (CHANGED, wrong) if wrong else (RIGHT, '')


def _forget_peak() -> float:
    """Let the peak of this process's memory start anew, where the system can; return it [MB]."""
    with suppress(OSError):
        Path('/proc/self/clear_refs').write_text('5')
    return _peak_mb()


def _peak_mb() -> float:
    """Return the most memory that this process had since then."""
    with suppress(OSError, AttributeError):
        found = re.search(r'VmHWM:\s*(\d+) kB', Path('/proc/self/status').read_text())
        return int(found[1]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
