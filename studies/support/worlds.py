"""
The worlds that studies print their columns of.

`ideal` is as the estimator's files say; `disturbed` departs from them (`continuum_loc.simulator`,
`worlds/disturbed.yaml`). Claims are the same in both; those of the disturbed world say so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar
from dataclasses import replace
from typing import Any, TypeVar

from continuum_loc.offline.claims import Claim
from continuum_loc.offline.trials import Trial

IDEAL, DISTURBED = 'ideal', 'disturbed'
# What studies run in; `evaluate --world` leaves one out.
WORLDS: ContextVar[tuple[str, ...]] = ContextVar('worlds', default=(IDEAL, DISTURBED))

R = TypeVar('R')


def in_worlds(trials: Sequence[Trial]) -> list[Trial]:
    """Put the same trials into every world."""
    return [replace(trial, world=world) for world in WORLDS.get() for trial in trials]


def by_world(results: Iterable[R], trial_of: Callable[[R], Trial]) -> dict[str, list[R]]:
    """Sort results by the world of their trial, in order of appearance."""
    found: dict[str, list[R]] = {}
    for result in results:
        found.setdefault(trial_of(result).world, []).append(result)
    return found


def told(claims: Iterable[Claim], world: str) -> list[Claim]:
    """Say of claims in which world they are made; those of the ideal one keep their names."""
    if world == IDEAL:
        return list(claims)
    return [replace(claim, name=f'{world}: {claim.name}') for claim in claims]


def named(name: str, world: str) -> str:
    """Name a table of a world; that of the ideal one keeps its name."""
    return name if world == IDEAL else f'{name}_{world}'


def column(rows: Iterable[dict[str, Any]], world: str) -> list[dict[str, Any]]:
    """Put the world before each row of a table."""
    return [{'world': world, **row} for row in rows]
