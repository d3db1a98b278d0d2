"""
Samples of the future at the right time.

A thread prepares them ahead, a caller publishes them when due.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from queue import Empty, Full, Queue
import threading
import time
from typing import Any

from continuum_loc.measurements import NANOSECONDS

_END = object()
POLL = 0.1  # s; how often a blocked thread looks whether it has to stop


class Paced:
    """
    Delivers (stamp, item) pairs of an iterator when their time has come.

    lookahead [s]: how far the iterator may run ahead. rate: data seconds per second.
    longest_pause [s] of the data: a leap of the stamps farther than that is not waited for.
    """

    def __init__(
        self,
        items: Iterator[tuple[int, Any]],
        lookahead: float,
        rate: float = 1.0,
        longest_pause: float = float('inf'),
    ) -> None:
        self._items, self._lookahead, self._rate = items, lookahead, rate
        self._longest_pause = longest_pause * NANOSECONDS
        self._queue: Queue[Any] = Queue(maxsize=4000)
        self._stop = threading.Event()
        self._full = threading.Event()  # the first lookahead is prepared, or all there is
        self._progress: int | None = None  # time paced by that was delivered last, or the first
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._prepare, name='lookahead', daemon=True)

    def run(
        self,
        deliver: Callable[[int, Any, float], None],
        on_start: Callable[[int], None] = lambda stamp: None,
    ) -> None:
        """
        Deliver everything, then return; `stop` from another thread ends it early.

        `deliver(stamp, item, delay)`: delay [s] behind the item's time. `on_start(first stamp)` is
        called when the first lookahead is prepared (what compiles at its first use has then
        compiled) and due one lookahead from now.
        """
        self._thread.start()
        try:
            self._deliver_all(deliver, on_start)
        finally:
            # An interpreter that ends under a thread in compiled code, as of physics, crashes.
            self._stop.set()
            self._thread.join()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End `run` soon."""
        self._stop.set()

    def _deliver_all(
        self, deliver: Callable[[int, Any, float], None], on_start: Callable[[int], None]
    ) -> None:
        while not self._full.wait(POLL) and not self._stop.is_set():
            pass
        begin: float | None = None
        for at, stamp, item in self._prepared():
            if begin is None:
                begin, first = time.monotonic() + self._lookahead, at
                on_start(stamp)
            due = begin + (at - first) / NANOSECONDS / self._rate
            if not self._wait_until(due):
                break
            self._progress = at
            deliver(stamp, item, time.monotonic() - due)

    def _prepared(self) -> Iterator[tuple[int, int, Any]]:
        while not self._stop.is_set():
            try:
                entry = self._queue.get(timeout=POLL)
            except Empty:
                continue
            if entry is _END:
                return
            yield entry

    def _wait_until(self, due: float) -> bool:
        remaining = due - time.monotonic()
        while remaining > 0.0 and not self._stop.is_set():
            time.sleep(min(remaining, POLL))
            remaining = due - time.monotonic()
        return not self._stop.is_set()

    def _prepare(self) -> None:
        try:
            for at, stamp, item in self._steady():
                if not self._put((at, stamp, item), at):
                    return
        except BaseException as error:  # handed to the thread that delivers
            self._error = error
        self._full.set()
        self._put(_END, 0)

    def _steady(self) -> Iterator[tuple[int, int, Any]]:
        """(time to pace by, stamp, item), both in ns: the same but for leaps that are skipped."""
        skipped, last = 0, None
        for stamp, item in self._items:
            last = stamp if last is None else last
            if abs(stamp - last) > self._longest_pause:
                skipped += stamp - last
            last = stamp
            yield stamp - skipped, stamp, item

    def _put(self, entry: Any, at: int) -> bool:
        ahead = self._lookahead * self._rate * NANOSECONDS
        self._progress = at if self._progress is None else self._progress
        while at - self._progress > ahead and not self._stop.is_set():
            self._full.set()
            time.sleep(0.002)
        while not self._stop.is_set():
            try:
                self._queue.put(entry, timeout=POLL)
                return True
            except Full:
                self._full.set()
                continue
        return False
