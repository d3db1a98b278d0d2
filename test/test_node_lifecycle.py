"""Managed nodes: every state by every way, over real DDS, and what is undone on the way back."""

import signal
import time

from continuum_loc.measurements import nanoseconds
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from node_graph import BoxRobot, Client, COMPILING, fresh_domain, Process
import pytest

pytestmark = pytest.mark.timeout(300)
INPUTS = ('tof/points', 'imu/data_raw', 'strain', 'joint_states')
CONFIGURE, ACTIVATE, DEACTIVATE, CLEANUP, SHUTDOWN = (
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
)


@pytest.fixture(scope='module')
def box(tmp_path_factory):
    return BoxRobot(tmp_path_factory.mktemp('box'))


def estimator(box, folder, domain, **parameters):
    given = {
        'robot': box.path,
        'map': box.map,
        'settings': 'engine',
        'autostart': 'false',
        'warm_up': 'false',
        'diagnostics_rate': 10.0,
        'intake.max_backlog': 30.0,
    }
    return Process('estimator', domain, folder, **given | parameters)


class Manager:
    """Asks a node for its state and for transitions, once each: a transition is not repeatable."""

    def __init__(self, client, name='estimator'):
        self.client, self.name = client, name
        self._change = client.node.create_client(ChangeState, f'{name}/change_state')
        assert client.until(self._change.service_is_ready)
        self.state()  # both sides know of one another

    def state(self):
        answer = self.client.call(GetState, f'{self.name}/get_state', GetState.Request())
        return answer.current_state.label

    def change(self, transition):
        future = self._change.call_async(ChangeState.Request(transition=Transition(id=transition)))
        assert self.client.until(future.done, COMPILING)
        return future.result().success


def test_a_node_goes_through_all_states_when_told_to_and_hears_only_when_active(box, tmp_path):
    domain = fresh_domain()
    node = estimator(box, tmp_path, domain)
    with Client(domain) as client:
        manager = Manager(client)
        poses, diagnostics = client.hear('poses'), client.hear('/diagnostics')
        assert manager.state() == 'unconfigured'
        assert not manager.change(ACTIVATE)  # there is no such transition, and the node lives on
        assert manager.state() == 'unconfigured'
        for _ in range(2):  # the second time as the first
            assert manager.change(CONFIGURE)
            assert manager.state() == 'inactive'
            assert client.until(
                lambda: diagnostics and diagnostics[-1].statuses[0][2] == 'inactive'
            )
            assert client.node.count_subscribers('tof/points') == 0
            assert manager.change(ACTIVATE)
            assert manager.state() == 'active'
            client.await_listeners(*INPUTS)
            client.await_speakers()
            box.play(client, 1.5)
            assert client.until(lambda: poses, COMPILING), node.log
            assert manager.change(DEACTIVATE)
            assert client.until(lambda: client.node.count_subscribers('tof/points') == 0)
            assert manager.change(CLEANUP)
            assert client.until(lambda: client.node.count_publishers('poses') == 0)
            poses.clear()
            diagnostics.clear()
        assert manager.change(SHUTDOWN)
    assert node.wait() == 0, node.log
    assert 'Traceback' not in node.log


def test_by_itself_a_node_goes_all_the_way_and_says_its_state_meanwhile(
    box, tmp_path, monkeypatch
):
    """It answers while it compiles, and ends then within two seconds."""
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'empty'))
    domain = fresh_domain()
    node = estimator(box, tmp_path, domain, autostart='true', warm_up='true')
    with Client(domain) as client:
        node.await_log('compiling')
        assert Manager(client).state() == 'configuring'
    begin = time.monotonic()
    assert node.stop(signal.SIGINT) == 0
    assert time.monotonic() - begin < 2.0
    assert 'ready' not in node.log and 'Traceback' not in node.log


def test_a_signal_ends_a_node_that_a_manager_has_told_to_configure(box, tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'empty'))
    domain = fresh_domain()
    node = estimator(box, tmp_path, domain, warm_up='true')
    with Client(domain) as client:
        manager = Manager(client)
        request = ChangeState.Request(transition=Transition(id=CONFIGURE))
        manager._change.call_async(request)
        client.until(lambda: 'compiling' in node.log)
        time.sleep(0.5)
        begin = time.monotonic()
        assert node.stop(signal.SIGINT) == 0, node.log
        assert time.monotonic() - begin < 2.0


def test_what_keeps_a_managed_node_from_being_configured_is_said_and_it_lives_on(box, tmp_path):
    domain = fresh_domain()
    node = estimator(box, tmp_path, domain, map=tmp_path / 'late.csv')
    with Client(domain) as client:
        manager = Manager(client)
        assert not manager.change(CONFIGURE)
        node.await_log('late.csv')
        assert manager.state() == 'unconfigured'
        (tmp_path / 'late.csv').write_text(box.map.read_text())
        assert manager.change(CONFIGURE), node.log
    assert node.stop() == 0, node.log
    assert 'Traceback' not in node.log


def test_a_recorder_writes_a_bag_for_each_time_that_it_is_active(box, tmp_path):
    from msg_tools.bag import read_bag

    domain = fresh_domain()
    node = Process('recorder', domain, tmp_path, autostart='false')
    with Client(domain) as client:
        manager = Manager(client, 'recorder')
        assert manager.change(CONFIGURE) and manager.state() == 'inactive'
        for topic in INPUTS:
            client.publisher(topic)
        sent = []
        for turn in range(2):
            assert manager.change(ACTIVATE), node.log
            client.await_listeners(*INPUTS)
            sent.append(client.now() + nanoseconds(turn))
            for topic, sample in box.samples(sent[-1]):
                client.send(topic, sample)
            client.spin(1.1)  # the name of a bag is a second's
            time.sleep(1.0)
            assert manager.change(DEACTIVATE)
    assert node.stop() == 0, node.log
    bags = sorted(tmp_path.glob('bag_*'))
    assert len(bags) == 2
    for bag, stamp in zip(bags, sent, strict=True):
        stamps = {sample.stamp for topic, sample in read_bag(bag) if topic != 'strain'}
        assert stamps == {stamp}  # (a strain's is a double of seconds)
