"""The simulated rod obeys mechanics: statics, stretch, frequency, dissipation, tendons."""

from continuum_loc.errors import SettingsError, SimulationDiverged
from continuum_loc.lie import rotation_error_deg
from continuum_loc.robot import Ring, RobotDescription
from continuum_loc.settings import parse_settings
from continuum_loc.simulator import model as rod_model
from continuum_loc.simulator.model import advance, build_model, GRAVITY, settle, uniform_rod
from continuum_loc.simulator.plant import load_plant, node_arclengths, PlantSettings
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import mujoco
import numpy as np
import pytest
from studies.simulator import first_mode
from studies.support.cosserat import cosserat_shape, elastica_tip

LENGTH, EI, MASS = 1.0, 0.05, 0.02


def settled_tip(links, force=(0, 0, 0), moment=(0, 0, 0), supported=True, **kwargs):
    model = uniform_rod(links, LENGTH, EI, MASS, supported=supported, **kwargs)
    data = mujoco.MjData(model)
    data.xfrc_applied[-1] = [*force, *moment]
    settle(model, data, rest_speed=1e-6)
    mujoco.mj_forward(model, data)
    return data.body('tip').xpos.copy(), data.body('tip').xmat.reshape(3, 3).copy()


def test_reference_solutions_agree_with_each_other():
    """The shooting solution of the rod's equations gives the elastica's elliptic integrals."""
    T = cosserat_shape([LENGTH], LENGTH, EI, EI, tip_force=(0, 0, -0.2))[0]
    x, drop = elastica_tip(0.2, EI, LENGTH)
    np.testing.assert_allclose(T[:3, 3], [x, 0.0, -drop], atol=1e-7)


def test_small_end_load_bends_a_cantilever_by_PL3_over_3EI():
    tip, _ = settled_tip(50, force=(0, 0, -1e-3))
    assert -tip[2] == pytest.approx(1e-3 * LENGTH**3 / (3 * EI), rel=2e-3)


@pytest.mark.parametrize('force', [0.05, 0.2, 0.5])
def test_large_end_load_gives_the_elastica(force):
    tip, _ = settled_tip(24, force=(0, 0, -force))
    x, drop = elastica_tip(force, EI, LENGTH)
    assert np.linalg.norm(tip - [x, 0.0, -drop]) < 0.005 * LENGTH


def test_end_moment_bends_the_rod_to_a_circular_arc():
    angle = 2.0
    tip, R = settled_tip(24, moment=(0, angle * EI / LENGTH, 0))
    radius = LENGTH / angle
    expected = np.array([np.sin(angle), 0.0, np.cos(angle) - 1.0]) * radius
    assert np.linalg.norm(tip - expected) < 0.005 * LENGTH
    np.testing.assert_allclose(R[:, 0], [np.cos(angle), 0.0, -np.sin(angle)], atol=1e-6)


def test_own_weight_and_a_load_out_of_plane_give_the_cosserat_rod():
    force = (0.0, 0.05, -0.02)
    tip, R = settled_tip(24, force=force, supported=False)
    T = cosserat_shape([LENGTH], LENGTH, EI, EI, weight=MASS * GRAVITY, tip_force=force)[0]
    assert np.linalg.norm(tip - T[:3, 3]) < 1e-3 * LENGTH
    assert np.linalg.norm(R - T[:3, :3]) < 2e-3


def test_tip_error_falls_with_the_square_of_the_link_length():
    x, drop = elastica_tip(0.2, EI, LENGTH)
    errors = [
        np.linalg.norm(settled_tip(n, force=(0, 0, -0.2))[0] - [x, 0.0, -drop])
        for n in (8, 16, 32)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all((orders > 1.9) & (orders < 2.1)), orders


def test_hanging_rod_stretches_by_half_its_weight_over_its_stiffness():
    stiffness = 40.0
    robot = RobotDescription(
        name='rod',
        length=LENGTH,
        radius=0.01,
        rings=(Ring(name='end', s=LENGTH),),
        base={'rpy_deg': (0.0, 90.0, 0.0)},
    )
    plant = PlantSettings(
        EI=EI,
        GJ=EI,
        EA=stiffness,
        mass_per_metre=MASS,
        profiles={'live': {'link_length': LENGTH / 20, 'time_step': 0.005}},
    )
    model = build_model(robot, plant)
    data = mujoco.MjData(model)
    settle(model, data, rest_speed=1e-6)
    mujoco.mj_forward(model, data)
    stretch = -data.body('node20').xpos[2] - LENGTH
    assert stretch == pytest.approx(MASS * GRAVITY * LENGTH**2 / (2 * stiffness), rel=2e-3)


@pytest.mark.parametrize('time_step', [0.002, 0.005])
def test_first_mode_has_the_frequency_of_euler_and_bernoulli_and_the_integrators_damping(
    time_step,
):
    found = first_mode(24, time_step)
    assert found['frequency [Hz]'] == pytest.approx(found['Euler-Bernoulli [Hz]'], rel=0.02)
    assert found['damping ratio'] == pytest.approx(found['omega h / 2'], rel=0.1)


def test_a_released_rod_only_loses_energy():
    model = uniform_rod(24, LENGTH, EI, MASS)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    energy = []
    for _ in range(400):
        advance(model, data)
        energy.append(data.energy.sum())
    lost = energy[0] - energy[-1]
    assert lost > 0.05 * MASS * GRAVITY * LENGTH
    assert np.diff(energy).max() < 1e-3 * lost


def tendon_rod(EA=None, relaxation=0.05, max_force=200.0, friction=0.0):
    robot = RobotDescription(
        name='rod', length=LENGTH, radius=0.03, rings=(Ring(name='end', s=LENGTH),)
    )
    plant = PlantSettings(
        EI=EI,
        GJ=EI,
        EA=EA,
        mass_per_metre=MASS,
        relaxation=relaxation,
        tendons=(
            {
                'end': LENGTH,
                'azimuth_deg': (0, 90, 180, 270),
                'radius': 0.02,
                'max_force': max_force,
                'friction': friction,
            },
        ),
        profiles={'live': {'link_length': LENGTH / 40, 'time_step': 0.005}},
    )
    return plant, build_model(robot, plant, supported=True)


@pytest.mark.parametrize('moment', [(0.05, 0.0), (0.0, 0.06), (-0.04, 0.03)])
def test_tensions_for_a_moment_bend_the_rod_by_that_moment(moment):
    """The tip turns by L / EI times the moment, about the moment's axis."""
    plant, model = tendon_rod()
    data = mujoco.MjData(model)
    data.ctrl[:] = plant.tension_for_moments(np.array([moment]), pretension=0.5)
    settle(model, data, rest_speed=1e-6)
    mujoco.mj_forward(model, data)
    quat = data.body('node40').xquat
    turn = np.zeros(3)
    mujoco.mju_quat2Vel(turn, quat, 1.0)
    np.testing.assert_allclose(
        turn, [0.0, moment[0] * LENGTH / EI, moment[1] * LENGTH / EI], atol=0.01
    )


def test_equal_tensions_shorten_an_extensible_rod_by_their_sum_over_EA():
    stiffness = 100.0
    _, model = tendon_rod(EA=stiffness)
    data = mujoco.MjData(model)
    data.ctrl[:] = 2.0
    settle(model, data, rest_speed=1e-6)
    mujoco.mj_forward(model, data)
    assert LENGTH - data.body('node40').xpos[0] == pytest.approx(
        8.0 * LENGTH / stiffness, rel=1e-3
    )
    np.testing.assert_allclose(data.ten_length, LENGTH * (1.0 - 8.0 / stiffness), rtol=1e-3)


def test_tendon_friction_leaves_a_hysteresis():
    """The same tension F bends as F - 2 f from below and as F + 2 f from above: both rub."""
    friction, pull = 0.5, 3.0
    plant, model = tendon_rod(friction=friction)
    data = mujoco.MjData(model)
    bends = []
    for tension in (pull, 2.0 * pull, pull):
        data.ctrl[:] = [tension, 0.0, 0.0, 0.0]
        data.time = 0.0
        settle(model, data, rest_speed=1e-3)
        mujoco.mj_forward(model, data)
        R = data.body('node40').xmat.reshape(3, 3)
        bends.append(np.arctan2(R[1, 0], R[0, 0]))
    up, _, down = bends
    per_newton = plant.tendons[0].radius * LENGTH / EI
    assert (down - up) / per_newton == pytest.approx(4.0 * friction, rel=0.1)


@given(arrays(float, (3, 2), elements=st.floats(-2.0, 2.0)), st.floats(0.0, 20.0))
def test_tensions_add_up_to_the_moments_wanted_in_every_stretch(moments, pretension):
    """A tension F at (r_y, r_z) bends every stretch up to its end by F (-r_z, r_y)."""
    plant = load_plant('engine')
    tension = plant.tension_for_moments(moments, pretension)
    ends = np.repeat([group.end for group in plant.tendons], 3)
    angle = np.radians(np.concatenate([group.azimuth_deg for group in plant.tendons]))
    arms = plant.tendons[0].radius * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    for stretch, group in enumerate(plant.tendons):
        reach = ends >= group.end
        np.testing.assert_allclose(
            (tension[reach, None] * arms[reach]).sum(axis=0), moments[stretch], atol=1e-9
        )


def test_tensions_keep_the_pretension_and_a_moment_out_of_reach_is_refused():
    plant = load_plant('engine')
    moments = np.random.default_rng(1).normal(0.0, 1.5, (200, 3, 2))
    tension = plant.tension_for_moments(moments, pretension=3.0)
    assert tension.shape == (200, 9) and tension.min() >= 3.0
    with pytest.raises(
        ValueError, match=r'tendon3_\d would have to pull \d+ N, its limit is 600 N'
    ):
        plant.tension_for_moments(np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 30.0]]))


def test_a_diverging_simulation_stops_with_the_joint_and_what_to_change():
    _, model = tendon_rod(relaxation=0.0, max_force=1e7)
    data = mujoco.MjData(model)
    data.ctrl[:] = [1e7, 0.0, 0.0, 0.0]
    with pytest.raises(
        SimulationDiverged, match=r"diverged at .* joint '(bend|stretch)\d+'.*time_step"
    ):
        for _ in range(2000):
            advance(model, data)


def test_a_robot_that_never_rests_is_refused(monkeypatch):
    monkeypatch.setattr(rod_model, 'SETTLE_LIMIT', 0.2)
    model = uniform_rod(10, LENGTH, EI, MASS)
    with pytest.raises(SimulationDiverged, match='did not come to rest'):
        settle(model, mujoco.MjData(model))


def test_an_unstable_time_step_is_refused_before_the_start():
    plant = load_plant('engine').model_copy(update={'carriage_stiffness': 1e8})
    from continuum_loc.robot import load_robot

    with pytest.raises(SettingsError, match=r'time_step 0.005 s is too long .* use at most'):
        build_model(load_robot('engine'), plant)


@pytest.mark.parametrize('name', ['engine', 'soft_arm', 'hall_arm'])
def test_every_ring_and_module_end_is_a_node(name):
    from continuum_loc.robot import load_robot

    robot, plant = load_robot(name), load_plant(name)
    for profile in plant.profiles.values():
        nodes = node_arclengths(robot, plant, profile.link_length)
        wanted = [
            0.0,
            robot.length,
            *robot.ring_arclengths,
            *(group.end for group in plant.tendons),
        ]
        assert np.abs(nodes[:, None] - wanted).min(axis=0).max() < 1e-9
        assert np.all(np.diff(nodes) > 0) and np.diff(nodes).max() < 1.5 * profile.link_length


def test_the_full_engine_profile_is_the_papers():
    from continuum_loc.robot import load_robot

    plant = load_plant('engine')
    nodes = node_arclengths(load_robot('engine'), plant, plant.profile('full').link_length)
    assert len(nodes) == 151
    np.testing.assert_allclose(np.diff(nodes), 0.01, atol=1e-9)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'GJ': 0.4}, 'GJ = 0.4 must lie between 0.1 and 1.8 times EI = 5.0'),
        ({'GJ': 9.1}, 'GJ = 9.1 must lie between'),
        (
            {'tendons': load_plant('engine').model_dump()['tendons'][::-1]},
            r'from base to tip.* ends \[1.5, 1.0, 0.5\]',
        ),
        ({'EI': -1.0}, 'EI'),
        ({'stifness': 1.0}, "unknown key 'stifness'"),
        ({'profiles': {'live': {'link_length': 0.03, 'time_step': 0.5}}}, 'time_step'),
    ],
)
def test_bad_plants_are_refused_with_their_place(change, message):
    with pytest.raises(SettingsError, match=message):
        parse_settings(
            PlantSettings, {**load_plant('engine').model_dump(), **change}, where='plant.yaml'
        )


def test_unknown_plants_and_profiles_name_the_valid_ones():
    with pytest.raises(SettingsError, match='engine, hall_arm, soft_arm'):
        load_plant('enginee')
    with pytest.raises(SettingsError, match='full, live'):
        load_plant('engine').profile('fast')


# Torsion of its own, beside the ball joints' one stiffness.


@pytest.mark.parametrize('ratio', [0.3, 1.0 / 1.3, 1.7])
def test_an_end_torque_twists_a_straight_rod_by_TL_over_GJ(ratio):
    torque = 0.02
    _, R = settled_tip(24, moment=(torque, 0, 0), GJ=ratio * EI)
    turn = np.zeros(3)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, R.ravel())
    mujoco.mju_quat2Vel(turn, quat, 1.0)
    np.testing.assert_allclose(
        turn, [torque * LENGTH / (ratio * EI), 0.0, 0.0], rtol=1e-3, atol=1e-6
    )


@pytest.mark.parametrize('ratio', [0.3, 1.0 / 1.3, 1.7])
def test_a_bent_and_twisted_rod_is_the_cosserat_rod_of_its_own_torsion(ratio):
    """The error falls with the square of the link length, as without torsion."""
    force, moment = (0.0, 0.05, -0.05), (0.03, 0.0, 0.02)
    T = cosserat_shape([LENGTH], LENGTH, EI, ratio * EI, tip_force=force, tip_moment=moment)[0]

    def turned(links, GJ):  # torsion turns the tip, and does not move it
        R = settled_tip(links, force, moment, GJ=GJ)[1]
        return rotation_error_deg(R, T[:3, :3])

    coarse, fine = (turned(links, ratio * EI) for links in (12, 24))
    assert fine < 0.2
    assert 1.8 < np.log2(coarse / fine) < 2.2
    assert turned(24, EI) > 20.0 * fine


def test_a_plant_without_torsion_of_its_own_gets_no_torque():
    assert uniform_rod(4, LENGTH, EI, MASS).nuser_jnt == 0
    assert build_model_of('engine').nuser_jnt == 0


def build_model_of(name):
    from continuum_loc.robot import load_robot

    return build_model(load_robot(name), load_plant(name))
