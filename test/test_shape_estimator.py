"""Calibration, the joint backbone fit, and the online estimator on exactly known shapes."""

from dataclasses import replace

from continuum_loc import lie
from continuum_loc.errors import CalibrationError, MotionError, SettingsError
from continuum_loc.magnet import ring_field
from continuum_loc.measurements import FieldSample, ImuSample, NANOSECONDS, seconds, StrainSample
from continuum_loc.robot import load_robot
from continuum_loc.settings import dump_settings, parse_settings
from continuum_loc.shape import curves, load_shape_settings, ShapeEstimator, ShapeSettings
from continuum_loc.shape.backbone import _forward, BackboneSolver
from continuum_loc.shape.calibration import (
    calibrate,
    Calibration,
    load_calibration,
    module_mounts,
    nominal_calibration,
)
from continuum_loc.shape.rest import RestWindow
from continuum_loc.simulator.hall_arm import (
    Arm,
    bent,
    groove_motion,
    GROOVES,
    Motion,
    out_of_plane,
    PERFECT,
    s_shape,
)
import numpy as np
import pytest
from studies.support.shape_curves import at_fractions
from studies.support.shape_paper import Background, MENDS, paper_pipeline

ROBOT = load_robot('hall_arm')
S = np.array([0.025, 0.050, 0.075])


def estimates(estimator, samples):
    return [estimate for estimate in map(estimator.process, samples) if estimate is not None]


def true_poses(arm, strain):
    return ROBOT.base.T_map_base @ arm.T_base_module(strain)


@pytest.fixture(scope='module')
def arm():
    return Arm(ROBOT, seed=11)


@pytest.fixture(scope='module')
def calibration(arm):
    return calibrate(ROBOT, arm.calibration_rests())


@pytest.fixture(scope='module')
def recording(arm):
    return arm.record(groove_motion(arm, bent(ROBOT, 12.5, 0.6)))


# The simulated arm itself


def test_simulated_gyro_and_accelerometer_agree_with_the_motion():
    """
    Integrating a perfect arm's gyro gives its rotation.

    At rest it reads g along the true up.
    """
    arm = Arm(ROBOT, PERFECT)
    strain = out_of_plane(ROBOT, 20.0)
    samples = arm.record(groove_motion(arm, strain, rest=0.5, travel=1.0, hold=0.5))
    for m in range(3):
        mine = [s for s in samples if s.sensor == ROBOT.imu[m].name]
        R = (ROBOT.base.T_map_base[:3, :3]) @ module_mounts(ROBOT)[0][m]
        for before, after in zip(mine, mine[1:], strict=False):
            rate = 0.5 * (before.angular_velocity + after.angular_velocity)
            R = R @ lie.so3_exp(rate * seconds(after.stamp, before.stamp))
        end = true_poses(arm, strain)[m, :3, :3] @ module_mounts(ROBOT)[0][m]
        assert lie.rotation_error_deg(R, end) < 0.02
        np.testing.assert_allclose(end @ mine[-1].linear_acceleration, [0.0, 0.0, 9.81], atol=1e-5)


def test_simulated_backbone_is_inextensible_and_passes_the_modules(arm):
    strain = s_shape(ROBOT, 25.0, 0.3)
    s = np.linspace(0.0, ROBOT.length, 2001)
    assert curves.arclength(arm.backbone(strain, s))[-1] == pytest.approx(ROBOT.length, rel=1e-6)
    np.testing.assert_allclose(
        arm.backbone(strain, S), arm.T_base_module(strain)[:, :3, 3], atol=1e-15
    )


def test_same_seed_same_samples():
    one, two = (Arm(ROBOT, seed=3) for _ in range(2))
    for a, b in zip(one.taring_rest().rest.field, two.taring_rest().rest.field, strict=True):
        np.testing.assert_array_equal(a, b)


# Rest and calibration


def test_rest_tells_motion_and_seldom_cries_wolf(arm):
    """At 6 sigma over 27 channels a false alarm is a matter of 1e-7: none in 20 rests."""
    for _ in range(20):
        arm.taring_rest(1.0)
    slow = Motion([arm.posture(), arm.posture(bent(ROBOT, 1.0))], [0.0, 0.0], [0.0, 2.0])
    window = RestWindow(ROBOT)
    for sample in arm.record(slow):
        window.add(sample)
    with pytest.raises(MotionError, match='motion during taring: module1_imu'):
        window.finish()


def test_rest_names_what_is_silent():
    window = RestWindow(ROBOT)
    window.add(ImuSample(1, 'module1_imu', np.zeros(3), np.zeros(3)))
    with pytest.raises(ValueError, match='module1_hall, module2_hall, module2_imu'):
        window.finish()


def test_calibration_finds_what_is_wrong_with_the_arm(arm, calibration):
    imu, hall = module_mounts(ROBOT)
    turned = imu @ lie.so3_exp(np.array([m.imu_turn for m in calibration.modules]))
    # 0.5 deg before, base poses good to 0.05.
    assert lie.rotation_error_deg(turned, arm.R_module_imu).max() < 0.08
    turned = hall @ lie.so3_exp(np.array([m.hall_turn for m in calibration.modules]))
    assert lie.rotation_error_deg(turned, arm.R_module_hall).max() < 0.25
    assert calibration.remanence == pytest.approx(arm.magnet.remanence, rel=2.5e-3)  # 2 % before
    np.testing.assert_allclose(calibration.earth_field, arm.imperfections.earth_field, atol=0.3e-6)
    offsets = np.array([m.accel_offset for m in calibration.modules])
    np.testing.assert_allclose(offsets, arm.accel_offset, atol=0.02)


def test_calibration_of_a_perfect_arm_corrects_nothing():
    found = calibrate(ROBOT, Arm(ROBOT, PERFECT).calibration_rests(0.2))
    for module in found.modules:
        np.testing.assert_allclose([*module.imu_turn, *module.hall_turn], 0.0, atol=2e-4)
    assert found.remanence == pytest.approx(ROBOT.magnet.remanence, rel=2e-4)


def test_calibration_files_come_back_equal_and_refuse_other_robots(tmp_path, calibration):
    path = tmp_path / 'calibration.yaml'
    dump_settings(calibration, path)
    assert load_calibration(path, ROBOT) == calibration
    fewer = Calibration(modules=calibration.modules[:2], remanence=1.0)
    dump_settings(fewer, path)
    with pytest.raises(
        SettingsError, match="calibration of 2 modules, but robot 'hall_arm' has 3"
    ):
        ShapeEstimator(ROBOT, ShapeSettings(calibration=path))


def test_contradictory_rests_are_refused(arm):
    rests = arm.calibration_rests(0.5)
    with pytest.raises(CalibrationError, match='contradict one another'):
        calibrate(ROBOT, [replace(rests[0], T_map_base=rests[3].T_map_base), *rests[1:]])
    with pytest.raises(CalibrationError, match='at least one rest'):
        calibrate(ROBOT, [])


def test_robot_without_magnet_is_refused():
    with pytest.raises(SettingsError, match='cannot sense its shape'):
        ShapeEstimator(load_robot('engine'))


# The joint fit


def test_joint_fit_recovers_arcs_from_fields_and_attitudes_alike():
    rng = np.random.default_rng(2)
    solver = BackboneSolver(ROBOT, S)
    strain = rng.normal(size=(3, 3)) * [0.02, 12, 12]
    T = np.eye(4)
    poses = []
    for row in strain:
        T = T @ lie.exp(0.025 * np.array([1.0, 0.0, 0.0, *row]))
        poses.append(T)
    poses = np.stack(poses)
    earth = np.array([1e-5, -3e-5, 2e-5])
    field = np.einsum(
        'mji,mj->mi', poses[:, :3, :3], ring_field(ROBOT.magnet, poses[:, :3, 3]) + earth
    )
    information = np.stack([np.eye(3) * 1e6] * 3)
    fit = solver.solve(field, np.full((3, 3), 1e-7), earth, poses[:, :3, :3], information)
    assert fit.converged
    np.testing.assert_allclose(fit.T_base_module[:, :3, 3], poses[:, :3, 3], atol=2e-5)


def test_joint_fit_to_nothing_is_the_prior():
    """The robot file's curvature of 15 1/m (1 sigma) from its rest, which is straight."""
    fit = BackboneSolver(ROBOT, S[:1], step_sigma=0.01).solve(
        np.zeros((1, 3)),
        np.full((1, 3), np.inf),
        np.zeros(3),
        np.eye(3)[None],
        np.zeros((1, 3, 3)),
    )
    np.testing.assert_allclose(fit.strain, 0.0, atol=1e-9)
    np.testing.assert_allclose(fit.T_base_module[0, :3, 3], [0.025, 0.0, 0.0], atol=1e-12)
    # One stiff arc of 25 mm turns its end by 25 mm * 15 1/m.
    turn = np.sqrt(np.diag(fit.covariance[0])[4:])
    np.testing.assert_allclose(turn, 0.025 * 15.0, rtol=1e-5)


def test_joint_fit_bridges_a_module_that_says_nothing(arm, calibration, recording):
    """
    Without the middle module's readings its pose is the backbone's.

    Still within a tenth of a millimetre.
    """
    begin = recording[0].stamp
    kept = [
        s for s in recording if seconds(s.stamp, begin) < 1.5 or not s.sensor.startswith('module2')
    ]
    estimator = ShapeEstimator(ROBOT, calibration=calibration)
    last = estimates(estimator, kept)[-1]
    truth = true_poses(arm, bent(ROBOT, 12.5, 0.6))
    assert last.faults == {'module2': ('imu silent', 'hall silent')} and last.status == 'degraded'
    np.testing.assert_allclose(last.T_map_module[:, :3, 3], truth[:, :3, 3], atol=3e-4)
    assert last.observable.tolist() == [True, False, True]
    sigma = np.sqrt(np.diagonal(last.covariance, axis1=1, axis2=2))
    assert sigma[1, :3].max() > sigma[0, :3].max()


def test_chain_of_arcs_differentiates_on_the_right():
    rng = np.random.default_rng(3)
    lengths = BackboneSolver(ROBOT, S).rod.lengths
    strain = rng.normal(size=(len(lengths), 3)) * [0.5, 15, 15]
    T, chain = _forward(strain, lengths)

    def shifted(k, h):
        step = np.zeros(strain.size)
        step[k] = h
        return _forward(strain + step.reshape(strain.shape), lengths)[0]

    h = 1e-5
    columns = [
        lie.log(lie.inverse(shifted(k, -h)) @ shifted(k, h)) / (2 * h) for k in range(strain.size)
    ]
    np.testing.assert_allclose(chain, np.stack(columns, axis=-1), atol=1e-8)


# The estimator


@pytest.mark.parametrize('position', ['modules', 'joint'])
@pytest.mark.parametrize(
    'strain',
    [bent(ROBOT, 0.0), bent(ROBOT, 25.0, 1.0), s_shape(ROBOT, 20.0), out_of_plane(ROBOT, 15.0)],
)
def test_perfect_arm_is_found_exactly(position, strain):
    """
    No noise: only quantisation and the gyro's integration are left.

    Quantisation: 0.24 uT at most, some 0.02 mm at 75 mm.

    The joint fit's prior on curvature holds it back by up to 0.15 mm.
    """
    arm = Arm(ROBOT, PERFECT)
    # A sensor without noise repeats itself, which is no sign of a frozen one here.
    settings = ShapeSettings(position=position, frozen_after=10**6)
    estimator = ShapeEstimator(ROBOT, settings, nominal_calibration(ROBOT))
    last = estimates(estimator, arm.record(groove_motion(arm, strain)))[-1]
    truth = true_poses(arm, strain)
    atol, degrees = (5e-5, 0.05) if position == 'modules' else (1.5e-4, 0.6)
    assert last.status == 'tracking' and not last.faults and not last.bound.any()
    np.testing.assert_allclose(last.T_map_module[:, :3, 3], truth[:, :3, 3], atol=atol)
    assert lie.rotation_error_deg(last.T_map_module[:, :3, :3], truth[:, :3, :3]).max() < degrees
    tip = arm.backbone(strain, np.array([ROBOT.length])) @ ROBOT.base.T_map_base[:3, :3].T
    # A quarter of the robot lies beyond the last module.
    assert np.linalg.norm(last.curve[-1] - tip) < 2e-3
    assert last.curve_s[-1] == pytest.approx(ROBOT.length, rel=5e-3)


@pytest.mark.parametrize('groove', GROOVES)
def test_calibrated_arm_finds_the_grooves(arm, calibration, groove):
    """
    Arc MAE well under the paper's 0.02 / 0.70 / 0.84 mm.

    But for one arm's noise in the straight groove.
    """
    strain = bent(ROBOT, GROOVES[groove], 0.6)
    last = estimates(
        ShapeEstimator(ROBOT, calibration=calibration), arm.record(groove_motion(arm, strain))
    )[-1]
    curve = (last.curve[:61] - ROBOT.base.T_map_base[:3, 3]) @ ROBOT.base.T_map_base[:3, :3]
    fractions = np.linspace(0.0, 1.0, 101)
    error = np.linalg.norm(
        at_fractions(curve, fractions) - arm.backbone(strain, 0.075 * fractions), axis=1
    )
    assert error.mean() < 5e-5 and error.max() < 1.5e-4


def test_stated_covariance_covers_the_errors():
    """
    Normalised squared error of the positions of 6 arms.

    54 values of mean 1 if honest and independent; they are not quite (one calibration serves three
    modules), so only gross over- and underconfidence fails.
    """
    nees = []
    for seed in range(6):
        arm = Arm(ROBOT, seed=100 + seed)
        strain = bent(ROBOT, 15.0, seed)
        estimator = ShapeEstimator(ROBOT, calibration=calibrate(ROBOT, arm.calibration_rests(1.0)))
        motion = groove_motion(arm, strain, rest=1.1, travel=1.0, hold=1.0)
        last = estimates(estimator, arm.record(motion))[-1]
        error = lie.log(lie.inverse(last.T_map_module) @ true_poses(arm, strain))[:, :3]
        nees.append(
            np.einsum('mi,mij,mj->m', error, np.linalg.inv(last.covariance[:, :3, :3]), error) / 3
        )
    assert 0.1 < np.mean(nees) < 3.0


def test_processing_is_deterministic_and_modules_may_come_in_any_order(calibration, recording):
    first = estimates(ShapeEstimator(ROBOT, calibration=calibration), recording)
    second = estimates(ShapeEstimator(ROBOT, calibration=calibration), recording)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.T_map_module, b.T_map_module)
    # All of module 3 delayed by 20 ms of arrival: the same samples, another order.
    late = sorted(
        recording, key=lambda s: s.stamp + (20_000_000 if s.sensor.startswith('module3') else 0)
    )
    shifted = estimates(ShapeEstimator(ROBOT, calibration=calibration), late)
    np.testing.assert_allclose(
        shifted[-1].T_map_module[:, :3, 3], first[-1].T_map_module[:, :3, 3], atol=3e-5
    )


def test_estimates_come_at_their_rate(calibration, recording):
    found = estimates(ShapeEstimator(ROBOT, ShapeSettings(rate=20.0), calibration), recording)
    gaps = np.diff([estimate.stamp for estimate in found]) / NANOSECONDS
    assert gaps.mean() == pytest.approx(0.05, rel=0.02) and gaps.max() < 0.06


def test_yaw_is_told_as_unobservable_by_a_growing_sigma(calibration, recording):
    found = estimates(ShapeEstimator(ROBOT, calibration=calibration), recording)
    yaw = np.array([estimate.yaw_sigma for estimate in found])
    assert (np.diff(yaw, axis=0) > 0.0).all()


def test_other_samples_are_counted_and_old_ones_dropped(calibration, recording):
    estimator = ShapeEstimator(ROBOT, calibration=calibration)
    estimator.process(StrainSample(1, np.zeros(1), np.zeros(1), np.zeros(1)))
    estimator.process(FieldSample(1, 'elsewhere', np.zeros(3)))
    estimator.process(recording[0])
    estimator.process(recording[0])
    assert estimator.counts == {'ignored': 2, 'used': 1, 'out of order': 1}
    with pytest.raises(ValueError, match="'module1_imu' at 5 is not finite"):
        ShapeEstimator(ROBOT).process(ImuSample(5, 'module1_imu', np.full(3, np.nan), np.zeros(3)))


def test_silent_from_the_start_is_refused_by_name(recording):
    estimator = ShapeEstimator(ROBOT)
    assert not estimates(estimator, [s for s in recording if s.sensor != 'module3_hall'])
    assert 'module3_hall' in estimator.message and estimator.counts['taring refused'] >= 1


def test_every_fault_is_told_for_what_it_is():
    from studies._shape_faults import fault_rows

    wrong = [(row['fault'], row['told']) for row in fault_rows(ROBOT, 4) if not row['right']]
    assert not wrong


@pytest.mark.parametrize('fault', ['silent', 'frozen'])
def test_module_that_comes_back_is_taken_up_again(arm, calibration, fault):
    """
    Module 2 is lost for 1.4 s on the way into the groove.

    Back, it knows its rotation from the backbone.
    """
    strain = bent(ROBOT, 12.5, 0.6)
    samples = arm.record(groove_motion(arm, strain))
    begin, last, stream = samples[0].stamp, {}, []
    for sample in samples:
        lost = 2.3 < seconds(sample.stamp, begin) < 3.7 and sample.sensor.startswith('module2')
        if lost and fault == 'frozen':
            stream.append(replace(last[sample.sensor], stamp=sample.stamp))
        elif not lost:
            stream.append(sample)
            last[sample.sensor] = sample
    found = estimates(ShapeEstimator(ROBOT, calibration=calibration), stream)
    truth = true_poses(arm, strain)
    assert any('module2' in estimate.faults for estimate in found) and not found[-1].faults
    assert np.linalg.norm(found[-1].T_map_module[1, :3, 3] - truth[1, :3, 3]) < 4e-4
    assert lie.rotation_error_deg(found[-1].T_map_module[1, :3, :3], truth[1, :3, :3]) < 2.0
    assert found[-1].yaw_sigma[1] > np.radians(2.0)


def test_reset_tares_again(calibration, recording):
    estimator = ShapeEstimator(ROBOT, calibration=calibration)
    before = estimates(estimator, recording)
    estimator.reset()
    assert estimator.status == 'taring' and not estimator.counts
    after = estimates(estimator, recording)
    np.testing.assert_array_equal(before[-1].T_map_module, after[-1].T_map_module)


def test_settings_load_and_refuse(tmp_path):
    path = tmp_path / 'shape.yaml'
    path.write_text('position: joint\nattitude: {gate: 0.3}\n')
    loaded = load_shape_settings(path)
    assert (
        loaded.position == 'joint'
        and loaded.attitude.gate == 0.3
        and load_shape_settings() == ShapeSettings()
    )
    with pytest.raises(SettingsError, match="did you mean 'smoothing'"):
        parse_settings(ShapeSettings, {'smoothin': 0.1})


# The paper's pipeline


def test_printed_errors_cost_what_the_study_says(arm):
    strain = bent(ROBOT, GROOVES['80 mm'], np.radians(-90.0))
    samples = arm.record(groove_motion(arm, strain))
    magnet, rest = arm.magnet, arm.taring_rest().rest
    arm.magnet = magnet.model_copy(update={'remanence': 0.0})
    background = Background.of(rest, arm.taring_rest().rest)
    arm.magnet = magnet
    truth = arm.T_base_module(strain)[:, :3, 3]
    printed, mended = (
        np.linalg.norm(
            paper_pipeline(ROBOT, samples, background, mends).points[1:] - truth, axis=1
        )
        for mends in ((), MENDS)
    )
    assert printed.max() > 0.03 and mended.max() < 0.008
    with pytest.raises(ValueError, match='unknown mends'):
        paper_pipeline(ROBOT, samples, background, ['everything'])
