"""
Studies behind the figures that the README quotes, one module each.

A study NAME is the module `studies.NAME`. It has a docstring, whose first line the command line
shows, and

    def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]

which does the work, leaves its results under `out` through `write_study`, and returns the same
claims.
"""

from __future__ import annotations

from collections.abc import Callable
import difflib
import importlib
from pathlib import Path
import pkgutil
from typing import TYPE_CHECKING

from continuum_loc.errors import StudyError

if TYPE_CHECKING:
    from continuum_loc.offline.claims import Claim

StudyRun = Callable[[Path, bool, int, int], 'list[Claim]']


def study_names() -> list[str]:
    """Names of the studies that come with the package."""
    return sorted(
        module.name
        for module in pkgutil.iter_modules(__path__)
        if not module.name.startswith('_') and not module.ispkg
    )


def load_study(name: str) -> StudyRun:
    """
    Find the `run` function of the study called `name`.

    Raises StudyError naming the nearest study.
    """
    names = study_names()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        hint = f" (did you mean '{close[0]}'?)" if close else ''
        raise StudyError(f"no study '{name}'{hint}; studies: {', '.join(names) or 'none'}")
    return importlib.import_module(f'studies.{name}').run
