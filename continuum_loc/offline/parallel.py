"""The same work on many inputs, in several processes or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass
import hashlib
import json
from typing import Any

from continuum_loc.errors import StudyError
from continuum_loc.offline.as_json import plain
from continuum_loc.offline.replay import one_thread

# Address of a Dask scheduler that runs the work instead of processes of our own; none by default.
SCHEDULER: ContextVar[str] = ContextVar('scheduler', default='')

CONNECT_LIMIT = 10  # s

Progress = Callable[[Iterator[Any], int, str], Iterator[Any]]


@dataclass(frozen=True)
class Outcome:
    """
    What became of a trial: its summary, or the error that ended it.

    The error is the last line of a traceback.
    """

    trial: Any  # a Trial, or a recorded one: what it must have is a `name`
    summary: dict[str, Any] | None
    error: str = ''


def parallel(work: Callable, arguments: list[tuple], jobs: int) -> Iterator[Any]:
    """
    Results of `work(*arguments)` as they come.

    A worker that dies ends the campaign; what is done stays done.
    """
    if SCHEDULER.get():
        yield from _distributed(work, arguments, SCHEDULER.get())
        return
    if jobs == 1:
        for each in arguments:
            with one_thread():
                result = work(*each)
            yield result
        return
    import multiprocessing

    # Fresh interpreters: forked ones would share the state of numeric libraries' threads.
    with ProcessPoolExecutor(jobs, multiprocessing.get_context('spawn')) as pool:
        for future in as_completed([pool.submit(_in_worker, work, *each) for each in arguments]):
            yield future.result()


def _distributed(work: Callable, arguments: list[tuple], address: str) -> Iterator[Any]:
    """
    Do the same on the workers of a Dask cluster.

    They must see the same files under the same names.
    """
    try:
        from distributed import as_completed as as_distributed
        from distributed import Client
    except ImportError:
        raise StudyError('a scheduler needs Dask: pip install distributed') from None
    try:
        client = Client(address, timeout=CONNECT_LIMIT)
    except (OSError, TimeoutError, ValueError) as error:
        raise StudyError(
            f'no Dask scheduler at {address} ({error or type(error).__name__})'
        ) from None
    with client:
        # The work is seeded, so a cached result would be right; but files are part of it, so
        # nothing is reused.
        futures = [client.submit(_in_worker, work, *each, pure=False) for each in arguments]
        for future in as_distributed(futures):
            yield future.result()


def _in_worker(work: Callable, *arguments: Any) -> Any:
    # For good: another thread of this worker must not find the limit lifted.
    one_thread()
    return work(*arguments)


def configuration_digest(*parts: Any) -> str:
    """Digest all that decides a result, so that it is taken as it is only while that is so."""
    return hashlib.sha256(json.dumps(plain(parts), sort_keys=True).encode()).hexdigest()


def show_progress(results: Iterator[Any], total: int, label: str) -> Iterator[Any]:
    """Pass results on, with a bar and the time left, on the terminal's error stream."""
    from rich.console import Console
    from rich.progress import track

    return track(results, label, total=total, console=Console(stderr=True), transient=True)
