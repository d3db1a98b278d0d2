"""Forces on the simulated body, and that the filter finds them."""

from continuum_loc.estimator import settings_of, SlidingWindowFilter
from continuum_loc.measurements import seconds, TruthSample
from continuum_loc.settings import parse_settings
from continuum_loc.simulator.forces import contact_forces, Push
from continuum_loc.simulator.world import START, World
import mujoco
import numpy as np
import pytest
from studies.support.actuated import simulated_robot

BALL = """
<mujoco><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body pos="0 0 0.0999"><freejoint/><geom type="sphere" size="0.1" mass="2"/></body>
</worldbody></mujoco>
"""


def test_the_floor_carries_a_ball_by_its_weight():
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    for _ in range(2000):
        mujoco.mj_step(model, data)
    ground, ball = contact_forces(model, data, np.array([0, 1]))
    assert np.allclose(ball, [0.0, 0.0, 2.0 * 9.81], atol=0.02) and np.allclose(ground, -ball)


def test_a_push_on_the_engine_robot_is_found_and_before_it_nothing():
    robot = simulated_robot('engine')
    force = np.array([0.0, 0.6, 0.0])
    world = World(robot, None, 't1', seed=2, pushes=(Push(1.2, tuple(force), start=1.5),))
    data = settings_of('engine').model_dump()
    data['tof']['enabled'] = False
    settings = parse_settings(type(settings_of('engine')), data)
    estimator, told = SlidingWindowFilter(robot, None, settings), []
    for sample in world.run(3.0):
        estimate = None if isinstance(sample, TruthSample) else estimator.process(sample)
        if estimate is not None:
            told.append((seconds(estimate.stamp, START), estimate.loads))
    assert not any(loads for time, loads in told if time < 1.5)
    found = [loads[0] for time, loads in told if time > 2.2 and loads]
    assert found
    assert np.median([np.linalg.norm(one.force) for one in found]) == pytest.approx(0.6, rel=0.25)
    assert np.median([one.s for one in found]) == pytest.approx(1.2, abs=0.1)
