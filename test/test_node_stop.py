"""A node that compiles for the first time, which takes minutes, ends when it is told to."""

import signal
import threading
import time

from continuum_loc.errors import SettingsError
from continuum_loc.nodes.support import managed, runtime
from continuum_loc.nodes.support.managed import PackageNode
from continuum_loc.nodes.support.settings import NodeSettings
from node_graph import BoxRobot, fresh_domain, Process
import pytest
import rclpy

pytestmark = pytest.mark.timeout(200)
AT_ONCE = 2.0  # s


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_a_node_ends_while_it_compiles(tmp_path, monkeypatch, how):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'empty'))
    box = BoxRobot(tmp_path)
    node = Process('estimator', fresh_domain(), tmp_path, robot=box.path, map=box.map)
    node.await_log('compiling')
    time.sleep(1.0)
    begin = time.monotonic()
    assert node.stop(how) == 0, node.log
    assert time.monotonic() - begin < AT_ONCE
    assert 'ready' not in node.log and 'Traceback' not in node.log


class Slow(PackageNode):
    """Configures until it is told to stop, and then ends by itself."""

    def __init__(self):
        super().__init__('slow', NodeSettings())
        self.check_parameters()
        self.ended = False

    def configure(self):
        while rclpy.ok():
            time.sleep(0.01)
        time.sleep(0.1)
        self.ended = True


def failing(error):
    class Failing(PackageNode):
        def __init__(self):
            super().__init__('failing', NodeSettings())

        def configure(self):
            raise error

    return Failing


def test_what_goes_wrong_while_a_node_is_configured_is_told(capsys, monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(fresh_domain()))
    assert runtime.run(failing(SettingsError('no such robot')), args=[]) == runtime.BAD_INPUT
    assert capsys.readouterr().err == 'error: no such robot\n'
    with pytest.raises(ZeroDivisionError, match='a bug'):
        runtime.run(failing(ZeroDivisionError('a bug')), args=[])


def test_a_node_that_ends_by_itself_when_told_to_is_not_left_in_the_middle(monkeypatch):
    """What it does then, such as closing a file, comes to its end."""
    monkeypatch.setenv('ROS_DOMAIN_ID', str(fresh_domain()))
    monkeypatch.setattr(managed, 'GRACE', 5.0)
    made = []

    def make():
        made.append(Slow())
        return made[0]

    threading.Timer(0.5, rclpy.shutdown).start()
    assert runtime.run(make, args=[]) == 0
    assert made[0].ended
