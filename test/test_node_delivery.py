"""Who publishes what must not be lost waits for listeners, but not for ever."""

from itertools import count

from continuum_loc.nodes.support.delivery import await_listeners, SETTLED_MATCH
import pytest


class Publisher:
    """Counts its subscriptions as it is told to."""

    topic_name = '/tof/points'

    def __init__(self, counts):
        self.counts = iter(counts)

    def get_subscription_count(self):
        return next(self.counts)


def test_one_listener_that_stays_is_enough():
    publisher = Publisher(min(number // 5, 1) for number in count())
    assert await_listeners([publisher], publisher, 1, 5.0, lambda: False)


def test_too_few_listeners_are_named():
    publisher = Publisher(1 for _ in count())
    with pytest.raises(TimeoutError, match='1 of 2 subscriptions listen to /tof/points'):
        await_listeners([publisher], publisher, 2, 0.1, lambda: False)


def test_listeners_that_come_and_go_are_not_waited_for_without_an_end():
    publisher = Publisher(1 + number % 2 for number in count())
    with pytest.raises(TimeoutError, match='still come and go after 1 s'):
        await_listeners([publisher], publisher, 1, 2.0 * SETTLED_MATCH, lambda: False)


def test_a_wait_ends_when_the_node_does():
    publisher = Publisher(1 + number % 2 for number in count())
    assert not await_listeners([publisher], publisher, 1, 60.0, lambda: True)
    assert not await_listeners([publisher], publisher, 9, 60.0, lambda: True)
