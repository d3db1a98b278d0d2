"""Publishers that lose nothing: begin when all listeners are there, end when they have it all."""

from __future__ import annotations

from collections.abc import Callable, Collection
import time
from typing import Any

from rclpy.duration import Duration

POLL = 0.02  # s
# What discovery says last before the data begins has to stand for so long: a reader of several
# topics is matched with one after the other.
SETTLED_MATCH = 0.5  # s
ACKNOWLEDGED = 2.0  # s that the slowest reader has for what it was sent last


def await_listeners(
    publishers: Collection[Any],
    first: Any,
    count: int,
    timeout: float,
    stopped: Callable[[], bool],
) -> bool:
    """
    Wait until `count` subscriptions listen to `first` and no more come to any publisher.

    False when stopped() meanwhile. Raises TimeoutError when there are too few after `timeout` [s],
    or when they still come and go after as long again.
    """
    deadline = time.monotonic() + timeout
    while first.get_subscription_count() < count:
        if stopped():
            return False
        if time.monotonic() > deadline:
            raise TimeoutError(
                f'{first.get_subscription_count()} of {count} subscriptions listen to '
                f'{first.topic_name} after {timeout:g} s'
            )
        time.sleep(POLL)
    return count == 0 or _settle(publishers, max(timeout, 2.0 * SETTLED_MATCH), stopped)


def _settle(publishers: Collection[Any], timeout: float, stopped: Callable[[], bool]) -> bool:
    """Wait until the number of subscriptions stays the same; False when stopped() meanwhile."""
    known, since = None, time.monotonic()
    deadline = since + timeout
    while time.monotonic() - since < SETTLED_MATCH:
        if stopped():
            return False
        if time.monotonic() > deadline:
            raise TimeoutError(
                f'subscriptions still come and go after {timeout:g} s: none kept its number '
                f'for {SETTLED_MATCH:g} s'
            )
        counts = [publisher.get_subscription_count() for publisher in publishers]
        if counts != known:
            known, since = counts, time.monotonic()
        time.sleep(POLL)
    return True


def await_acknowledged(publishers: Collection[Any]) -> None:
    """Wait until reliable readers have what was published: it goes with a publisher that ends."""
    deadline = time.monotonic() + ACKNOWLEDGED
    for publisher in publishers:
        left = max(deadline - time.monotonic(), 0.0)
        publisher.wait_for_all_acked(Duration(seconds=left))
