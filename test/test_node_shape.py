"""
Node `shape` as a process.

A straight Hall + IMU arm at rest, then bent, from the analytic simulation.
"""

import signal

from continuum_loc.nodes.shape import rehearse
from continuum_loc.robot import load_robot
from continuum_loc.shape import ShapeSettings
from node_graph import Client, COMPILING, fresh_domain, Process
import numpy as np
import pytest
from std_srvs.srv import Trigger

pytestmark = pytest.mark.timeout(300)
OUTPUTS = ('shape/poses', 'shape/curve', '/diagnostics')


@pytest.mark.parametrize('changed', [{}, {'position': 'joint'}, {'start': 'anyhow'}])
def test_the_rehearsal_before_the_first_message_goes_as_far_as_an_estimate(changed):
    """What it leaves out is compiled when data flows, half a minute of which is lost then."""
    settings = ShapeSettings().model_copy(update=changed)
    estimate = rehearse(load_robot('hall_arm'), settings)
    assert estimate is not None and np.isfinite(estimate.T_map_module).all()
    assert estimate.stamp > (settings.taring_seconds + settings.watch) * 1e9


def test_the_simulated_arm_is_followed_live(tmp_path):
    domain = fresh_domain()
    node = Process('shape', domain, tmp_path, diagnostics_rate=5)
    node.await_log('ready:', COMPILING)
    robot = load_robot('hall_arm')
    with Client(domain) as client:
        for topic in (*OUTPUTS, 'ground_truth/poses'):
            client.hear(topic)
        simulator = Process(
            'simulator',
            domain,
            tmp_path,
            robot='hall_arm',
            scene='none',
            trajectory='free1',
            duration=4,
            wait_for=1,
        )
        assert client.until(lambda: simulator.popen.poll() is not None)
        assert simulator.wait() == 0, simulator.log
        # The node may still be working through what it has buffered when the simulator is done.
        assert client.until(
            lambda: (
                all(client.heard[topic] for topic in OUTPUTS)
                and len(client.heard['shape/poses']) > 40
            )
        ), node.log
        poses, truth = client.heard['shape/poses'], client.heard['ground_truth/poses']
        assert all(len(pose.T_map_body) == len(robot.hall) for pose in poses)
        assert _error(poses, truth) < 0.003
        curve = client.heard['shape/curve'][-1].T_map_backbone
        np.testing.assert_allclose(np.linalg.det(curve[:, :3, :3]), 1.0, atol=1e-6)
        along = np.einsum('ij,ij->i', curve[:-1, :3, 0], np.diff(curve[:, :3, 3], axis=0))
        assert (along > 0.0).all()  # the frames' x points along the curve
        name, _, _, values = client.heard['/diagnostics'][-1].statuses[0]
        assert 'hall_arm' in name and 'faults' in values
        assert client.call(Trigger, 'shape/reset', Trigger.Request()).success
    assert node.stop(signal.SIGTERM) == 0 and 'Traceback' not in node.log, node.log


def _error(poses, truth):
    """Median over time of the worst module's position error [m]."""
    true = {sample.stamp: sample.T_map_ring for sample in truth}
    stamps = np.array(sorted(true))
    worst = []
    for pose in poses:
        nearest = stamps[np.argmin(np.abs(stamps - pose.stamp))]
        if abs(nearest - pose.stamp) < 20_000_000:
            difference = pose.T_map_body[:, :3, 3] - true[int(nearest)][1:, :3, 3]
            worst.append(np.linalg.norm(difference, axis=1).max())
    assert len(worst) > 30
    return float(np.median(worst))
