"""The spin of a node: it ends when the node says so, and leaves nothing behind at each turn."""

import gc
import tempfile
import threading
from types import FunctionType

from continuum_loc.errors import DomainError
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.runtime import _spin
from continuum_loc.nodes.support.settings import RecorderNodeSettings
from continuum_loc.offline.domain import Domain, DOMAINS
import pytest
import rclpy
from rclpy.context import Context

TURNS = 300


@pytest.fixture
def node():
    context = Context()
    with Domain() as domain:
        rclpy.init(context=context, domain_id=domain.number)
        made = PackageNode('spun', RecorderNodeSettings(), context=context)
        yield made
        made.destroy_node()
        rclpy.try_shutdown(context=context)


def test_a_turn_leaves_nothing_behind(node):
    """What `spin_until_future_complete` of rclpy does: a function at each turn, for ever."""
    counts = []

    def turn():
        counts.append(_functions() if len(counts) in (10, TURNS) else 0)
        if len(counts) > TURNS:
            node.finish()

    node.every(0.001, turn)
    _spin(node)
    assert counts[TURNS] - counts[10] < TURNS // 10


def _functions() -> int:
    gc.collect()
    return sum(type(one) is FunctionType for one in gc.get_objects())


@pytest.mark.timeout(60)
def test_a_node_that_hears_nothing_ends_when_another_thread_says_so(node):
    threading.Timer(0.2, node.finish).start()
    _spin(node)
    node.finish()  # twice does no harm
    _spin(node)  # one that has finished does not spin


def test_no_two_graphs_have_one_domain(tmp_path, monkeypatch):
    """Until one gives its own back, and then the next takes it."""
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))  # of others none is taken away
    first, second = Domain(), Domain()
    assert first.number != second.number and {first.number, second.number} <= set(DOMAINS)
    number = first.number
    first.close()
    held = []
    with pytest.raises(DomainError, match='taken'):
        while True:
            held.append(Domain())
    assert number in {domain.number for domain in held}
    assert second.number not in {domain.number for domain in held}
    for domain in (*held, second):
        domain.close()
