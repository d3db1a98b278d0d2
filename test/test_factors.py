"""Every factor's gradient and Hessian against differences of its own residuals, at random."""

from continuum_loc import lie
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import EstimatorSettings
from continuum_loc.estimator.factors import FACTORS, Setup
from continuum_loc.estimator.normal import Normal, symmetric
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.state import column_at_rest, Grid
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    StrainSample,
    TofFrame,
    TrackedPose,
)
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
from hypothesis import given
from hypothesis import settings as budget
from hypothesis import strategies as st
import numpy as np
import pytest
from worlds import EPOCH, Rod, rod, room_map, stream

DT = 0.1
# The loss is frozen per iteration, so only the quadratic part has a gradient to compare.
LOOSE = {'cauchy': 1e6}
SETTINGS = parse_settings(
    EstimatorSettings,
    {
        'gyro': LOOSE,
        'field': LOOSE,
        'strain': LOOSE,
        'tracker': LOOSE,
        # A floor that drowns the beam's own noise, whose share across the surface turns with the
        # body.
        'tof': {**LOOSE, 'gate': 1.0, 'min_cosine': 0.0, 'floor': 100.0},
        'gravity': {'enabled': True, 'gate': 100.0},
    },
)


def robot() -> RobotDescription:
    data = rod().model_dump()
    mount = {'xyz': [0.01, 0.0, 0.005], 'rpy_deg': [10.0, 20.0, 5.0]}
    data['trackers'] = [{'name': 'coil', 'ring': 'r2', 'mount': mount}]
    data['base']['insertion'] = {'mode': 'measured', 'range': [0.0, 0.5], 'sigma': 0.001}
    data['magnet'] = {'remanence': 1.1}
    data['hall'] = [{'name': 'r1_hall', 'ring': 'r1'}]
    return parse_settings(RobotDescription, data)


def columns(grid: Grid, seed: int):
    rng = np.random.default_rng(seed)
    strain = np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1)) + 0.2 * rng.normal(
        size=(grid.nodes, 6)
    )
    a = column_at_rest(grid, lie.exp(0.05 * rng.normal(size=6)), strain, 0.0)
    a = a.retract(0.05 * rng.normal(size=grid.dim))
    b = a.predict(DT).retract(0.02 * rng.normal(size=grid.dim))
    return a, b


def measurements(kind: str, description: RobotDescription):
    samples = list(stream(Rod(description), 0.1))
    rng = np.random.default_rng(1)
    if kind in ('gyro', 'gravity'):
        return [s for s in samples if isinstance(s, ImuSample)][:6]
    if kind == 'strain':
        return [s for s in samples if isinstance(s, StrainSample)]
    if kind == 'tof':
        return [s for s in samples if isinstance(s, TofFrame)][:7]
    if kind == 'field':
        return [FieldSample(EPOCH, 'r1_hall', 1e-6 * rng.normal(size=3)) for _ in range(4)]
    if kind == 'tracker':
        A = rng.normal(size=(6, 6))
        covariance = 1e-4 * (A @ A.T + np.eye(6))
        return [
            TrackedPose(
                EPOCH, 'coil', lie.exp(np.array([0.6, 0.0, 0.1, 0.2, 0.1, 3.0])), covariance
            )
        ]
    return [EncoderSample(EPOCH, ('tendon1', 'insertion'), np.array([0.0, 0.2]), np.zeros(2))]


def make_factor(
    kind: str, description: RobotDescription, grid: Grid, settings: EstimatorSettings = SETTINGS
):
    setup = Setup(description, grid, settings, room_map(0.05))
    factor = next(factor for factor in FACTORS if factor.name == kind)(setup)
    if kind == 'insertion':
        factor.plain = np.inf  # its loss is a square, then
    return factor


@pytest.mark.parametrize(
    'kind', ['gyro', 'strain', 'tof', 'tracker', 'insertion', 'gravity', 'field']
)
@pytest.mark.parametrize('seed', [0, 1])
def test_gradient_is_the_derivative_of_the_squared_error(kind, seed):
    description = robot()
    grid = Grid(description, 0.16)
    factor = make_factor(kind, description, grid)
    rows = [factor.row(m) for m in measurements(kind, description)]
    times = np.linspace(0.2, 0.9, len(rows)) * DT
    batch = factor.stack(times, rows)
    a, b = columns(grid, seed)
    normal = Normal.zeros(2 * grid.dim)
    factor.linearise(batch, a, b, normal)
    rng, bias = np.random.default_rng(seed), grid.bias_offset
    for _ in range(8):
        x, step = rng.normal(size=2 * grid.dim), 1e-6
        x_a, x_b = np.split(x, 2)
        if kind == 'gravity':
            x_a[bias:] = 0.0
        ends = [
            factor.linearise(
                batch,
                a.retract(sign * step * x_a),
                b.retract(sign * step * x_b),
                Normal.zeros(2 * grid.dim),
            ).squared
            for sign in (1.0, -1.0)
        ]
        slope = (ends[0] - ends[1]) / (4.0 * step)
        scale = np.linalg.norm(normal.g) * np.linalg.norm(x) / np.sqrt(len(x))
        if kind == 'tof':
            # Planarity weighs the information, not the reported squares; here it is one.
            assert np.all(factor.surface.planes.rows[:, 6] == 1.0)
        assert slope == pytest.approx(normal.g @ x, abs=1e-5 * scale + 1e-6 * abs(slope))


@pytest.mark.parametrize(
    'kind', ['gyro', 'strain', 'tof', 'tracker', 'insertion', 'gravity', 'field']
)
def test_hessian_is_an_upper_triangle_and_positive_semidefinite(kind):
    description = robot()
    grid = Grid(description, 0.16)
    factor = make_factor(kind, description, grid)
    rows = [factor.row(m) for m in measurements(kind, description)]
    normal = Normal.zeros(2 * grid.dim)
    factor.linearise(factor.stack(np.full(len(rows), 0.5 * DT), rows), *columns(grid, 3), normal)
    assert normal.H.any() and not np.tril(normal.H, -1).any()
    assert np.linalg.eigvalsh(symmetric(normal.H))[0] > -1e-9 * np.abs(normal.H).max()


@pytest.mark.parametrize('seed', range(3))
def test_prior_gradient(seed):
    description = robot()
    grid = Grid(description, 0.16)
    priors = Priors(description, grid, SETTINGS)
    a, b = columns(grid, seed)

    def cost_at(x, normal):
        x_a, x_b = np.split(x, 2)
        return priors.add(normal, a.retract(x_a), b.retract(x_b))[0]

    centre, rng = Normal.zeros(2 * grid.dim), np.random.default_rng(seed)
    cost_at(np.zeros(2 * grid.dim), centre)
    bias = grid.bias_offset
    for _ in range(8):
        x, step = rng.normal(size=2 * grid.dim), 1e-6
        for one in np.split(x, 2):
            one[bias:] = 0.0  # the bias walk reports no cost
        ends = [cost_at(sign * step * x, Normal.zeros(2 * grid.dim)) for sign in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / (2.0 * step)
        assert slope == pytest.approx(centre.g @ x, rel=1e-6)
    assert centre.H.any() and not np.tril(centre.H, -1).any()


def test_strain_matches_the_papers_map():
    """Eqs. 7-8: Ad(Rx(theta)) [1 0 0 0 0 kappa] has the bending that the factor measures."""
    description = robot()
    factor = make_factor('strain', description, Grid(description, 0.16))
    theta, kappa = np.array([0.3, -2.0]), np.array([0.8, 1.5])
    bending = factor.row(StrainSample(EPOCH, np.array([0.1, 0.5]), theta, kappa)).bending
    for i in range(2):
        T = np.eye(4)
        T[:3, :3] = lie.so3_exp(np.array([theta[i], 0.0, 0.0]))
        np.testing.assert_allclose(
            bending[i], (lie.adjoint(T) @ [1, 0, 0, 0, 0, kappa[i]])[4:], atol=1e-12
        )


def test_strain_noise_across_the_bending_plane():
    """Along the plane the noise is sigma_kappa, across it kappa sigma_theta where larger."""
    description = robot()
    factor = make_factor('strain', description, Grid(description, 0.16))
    kappa = 4.0
    _, bending, information = factor.row(
        StrainSample(EPOCH, np.array([0.1]), np.array([0.7]), np.array([kappa]))
    )
    covariance, along = np.linalg.inv(information[0]), bending[0] / kappa
    scale, noise = SETTINGS.strain.scale, description.strain
    assert along @ covariance @ along == pytest.approx((scale * noise.kappa_sigma) ** 2)
    across = np.array([-along[1], along[0]])
    assert across @ covariance @ across == pytest.approx((scale * kappa * noise.theta_sigma) ** 2)


@pytest.mark.parametrize('name, message', [('nobody', 'valid: r1_imu, r2_imu')])
def test_unknown_sensors_are_refused_with_the_valid_names(name, message):
    description = robot()
    factor = make_factor('gyro', description, Grid(description, 0.16))
    with pytest.raises(MeasurementError, match=message):
        factor.row(ImuSample(EPOCH, name, np.zeros(3), np.zeros(3)))


@pytest.mark.parametrize('sigmas, expected', [(3.0, 1.0 / (1.0 + 9.0)), (30.0, 1.0 / 20.0)])
def test_a_jerked_nodes_step_counts_less_to_a_limit_and_others_as_before(sigmas, expected):
    description = robot()
    grid = Grid(description, 0.16)
    priors = Priors(description, grid, EstimatorSettings())
    a = column_at_rest(grid, np.eye(4), np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1)), 0.0)
    still, jerked = a.predict(DT), a.predict(DT)
    # A change of velocity alone costs 4 / (q d) of its square; all 18 components share the loss.
    sigma = np.sqrt(priors.velocity_psd[2, 0] * DT / 4.0)
    jerked.velocity[2, 0] = sigmas * np.sqrt(18.0) * sigma

    def velocity_information(b):
        normal = Normal.zeros(2 * grid.dim)
        priors.add(normal, a, b)
        at = [18 * n + 12 for n in range(grid.nodes)]
        return normal.H[at, at]  # the older column's, which the step alone informs

    share = velocity_information(jerked) / velocity_information(still)
    others = np.ones(grid.nodes)
    others[2] = expected
    np.testing.assert_allclose(share, others, rtol=1e-9)


def gyro_at_rest(rates: np.ndarray, cauchy: float):
    """Cost, slope by the first IMU's bias (3,), and its information, of a body that is still."""
    description = robot()
    grid = Grid(description, 0.16)
    settings = parse_settings(EstimatorSettings, {'gyro': {'cauchy': cauchy}})
    factor = make_factor('gyro', description, grid, settings)
    R = description.imu[0].mount.T_ring_sensor[:3, :3]
    rows = [
        factor.row(ImuSample(EPOCH, description.imu[0].name, R.T @ rate, np.zeros(3)))
        for rate in rates
    ]
    a = column_at_rest(grid, np.eye(4), np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1)), 0.0)
    normal = Normal.zeros(2 * grid.dim)
    batch = factor.stack(np.linspace(0.1, 0.9, len(rates)) * DT, rows)
    report = factor.linearise(batch, a, a.predict(DT), normal)
    at = slice(grid.bias_offset, grid.bias_offset + 3)
    return report.cost, normal.g[at], symmetric(normal.H)[at, at]


def test_the_loss_of_a_gyro_is_the_integral_of_its_slope():
    rates, step = np.random.default_rng(0).normal(scale=0.5, size=(9, 3)), 1e-6
    _, slope, _ = gyro_at_rest(rates, 2.0)
    for i in range(3):
        shift = step * np.eye(3)[i]
        ends = [gyro_at_rest(rates + sign * shift, 2.0)[0] for sign in (-1.0, 1.0)]
        assert slope[i] == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=1e-5)


@budget(max_examples=60, deadline=None)
@given(
    bursts=st.integers(1, 5),
    quiet=st.integers(1, 5),
    size=st.floats(0.1, 1.5),
    cauchy=st.floats(0.5, 1e3),
)
def test_a_rattle_of_any_shape_keeps_its_mean_rate(bursts, quiet, size, cauchy):
    # Rare fast turns one way, frequent slow ones back: their mean is none.
    rates = np.zeros((bursts + quiet, 3))
    rates[:bursts, 1], rates[bursts:, 1] = size * quiet, -size * bursts
    _, slope, information = gyro_at_rest(rates, cauchy)
    assert abs(slope[1] / information[1, 1]) < 1e-12 * size


def test_a_gyro_that_rattles_says_less():
    rattle = 0.3 * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]] * 4)
    calm = gyro_at_rest(0.0 * rattle, 10.0)[2][1, 1]
    spread = 0.3**2 / (3.0 * (EstimatorSettings().gyro.scale * robot().imu_model.gyro_sigma) ** 2)
    expected = 1.0 / (1.0 + spread / 10.0**2)
    assert gyro_at_rest(rattle, 10.0)[2][1, 1] / calm == pytest.approx(expected, rel=1e-9)
