"""The factor of the tendons' statics: its gradient, and what joint states alone give."""

from continuum_loc import lie
from continuum_loc.actuation import Actuation
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.factors import Setup
from continuum_loc.estimator.factors.mechanics import MechanicsFactor
from continuum_loc.estimator.normal import Normal, symmetric
from continuum_loc.estimator.state import column_at_rest, Grid
from continuum_loc.measurements import EncoderSample, NANOSECONDS
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
import numpy as np
import pytest

EI, ARM = 0.5, 0.01
NAMES = ('a1', 'a2', 'b1', 'b2')


def robot(mode: str = 'tension', **more) -> RobotDescription:
    """One metre; two tendons towards +y and -y to the middle, two to the end."""
    tendons = [
        {'name': name, 'end': end, 'azimuth_deg': angle, 'radius': ARM}
        for name, end, angle in zip(NAMES, (0.5, 0.5, 1.0, 1.0), (0, 180, 0, 180), strict=True)
    ]
    block = Actuation(mode=mode, tendons=tendons, EI=(EI,), strain_sigma=(0.001, 0.05, 0.05))
    return RobotDescription(
        name='two',
        length=1.0,
        radius=0.02,
        backbone={'module_ends': (0.5,)},
        rings=[{'name': 'middle', 's': 0.5}, {'name': 'tip', 's': 1.0}],
        actuation=block.model_copy(update=more),
    )


def pulled(stamp: int, *tensions: float, names=NAMES) -> EncoderSample:
    values = np.array(tensions)
    return EncoderSample(stamp, names, np.full(len(values), np.nan), values)


def factor_of(description: RobotDescription) -> MechanicsFactor:
    settings = parse_settings(EstimatorSettings, {'mechanics': {'cauchy': 1e6}})
    return MechanicsFactor(Setup(description, Grid(description, 0.16), settings))


def s_bend(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Bend (to +y in the first half, to -y in the second), and the tensions that make it."""
    size = min(time, 1.0)
    # Moments: b2 pulls the whole to -y by 1.5 1/m, a1 the first half to +y by 3 1/m.
    return size * np.array([1.5, -1.5]), size * np.array([3.0, 0.0, 0.0, 1.5]) * EI / ARM


@pytest.mark.parametrize('seed', [0, 1])
def test_gradient_is_the_derivative_of_the_squared_error(seed):
    description = robot()
    factor, grid = factor_of(description), Grid(description, 0.16)
    rng = np.random.default_rng(seed)
    rows = [factor.row(pulled(k * NANOSECONDS, 40.0, 5.0, 9.0, 30.0 + k)) for k in range(2)]
    batch = factor.stack(np.array([0.02, 0.07]), rows)
    strain = np.tile([1.0, 0, 0, 0, 0, 0], (grid.nodes, 1)) + 0.2 * rng.normal(
        size=(grid.nodes, 6)
    )
    a = column_at_rest(grid, lie.exp(0.3 * rng.normal(size=6)), strain, 0.0)
    b = a.predict(0.1).retract(0.02 * rng.normal(size=grid.dim))
    normal = Normal.zeros(2 * grid.dim)
    factor.linearise(batch, a, b, normal)
    assert np.linalg.eigvalsh(symmetric(normal.H)).min() > -1e-6 * np.abs(normal.H).max()
    for _ in range(6):
        x, step = rng.normal(size=2 * grid.dim), 1e-6
        x_a, x_b = np.split(step * x, 2)
        ahead, behind = (
            factor.linearise(
                batch, a.retract(k * x_a), b.retract(k * x_b), Normal.zeros(2 * grid.dim)
            ).cost
            for k in (1.0, -1.0)
        )
        assert (ahead - behind) / (2.0 * step) == pytest.approx(normal.g @ x, rel=1e-4)


def test_expected_poses_are_two_arcs():
    factor = factor_of(robot())
    bend, tensions = s_bend(1.0)
    T, s = np.eye(4), factor.grid.s
    for n, step in enumerate(factor.row(pulled(0, *tensions)).T_node_next):
        T = T @ step
        first, rest = min(s[n + 1], 0.5), max(s[n + 1] - 0.5, 0.0)
        wanted = lie.exp(first * np.array([1.0, 0, 0, 0, 0, bend[0]])) @ lie.exp(
            rest * np.array([1.0, 0, 0, 0, 0, bend[1]])
        )
        assert np.allclose(T, wanted, atol=1e-6)


def test_information_is_that_of_a_straight_cantilever_of_unsure_strain():
    # A spread of the bending by d turns the end of a segment h by d h and moves it by d h^2 / 2.
    factor = factor_of(robot())
    h = np.diff(factor.grid.s)[0]
    covariance = np.linalg.inv(factor.information[0])
    assert covariance[5, 5] == pytest.approx((0.05 * h) ** 2)
    assert covariance[1, 5] == pytest.approx(0.05**2 * h * h**2 / 2.0)
    assert covariance[0, 0] == pytest.approx((0.001 * h) ** 2)


def test_a_bag_with_joint_states_alone_gives_the_s_bend():
    estimator, estimate = SlidingWindowFilter(robot()), None
    for k in range(100):
        time = 0.02 * k
        estimate = estimator.process(pulled(round(time * 1e9), *s_bend(time)[1])) or estimate
    half = lie.exp(0.5 * np.array([1.0, 0, 0, 0, 0, 1.5]))
    tip = half @ lie.exp(0.5 * np.array([1.0, 0, 0, 0, 0, -1.5]))
    assert np.linalg.norm(estimate.T_map_ring[2, :3, 3] - tip[:3, 3]) < 0.003
    assert np.linalg.norm(estimate.T_map_ring[1, :3, 3] - half[:3, 3]) < 0.003
    sigma = np.sqrt(np.diag(estimate.covariance[2]))
    assert 0.005 < sigma[1] < 0.05  # a spread of 0.05 1/m on one metre is 2.5 cm at the tip


def test_displacements_act_after_their_delay():
    # Bending k is least EI l k^2 / 2 + c (d - r l k)^2 / 2 over l = 0.5 m; the end turns by l k.
    description = robot('displacement', delay=0.1, EA=None)
    stiff = tuple(
        one.model_copy(update={'stiffness': 1e6}) for one in description.actuation.tendons
    )
    block = description.actuation.model_copy(update={'tendons': stiff})
    factor = factor_of(description.model_copy(update={'actuation': block}))
    for k, d in enumerate((0.0, 0.0025, 0.005)):
        sample = EncoderSample(
            k * NANOSECONDS // 10, NAMES, np.array([d, -0.01, -0.01, -0.01]), np.full(4, np.nan)
        )
        row = factor.row(sample)
    middle = factor.grid.node_at(0.5)
    T = np.linalg.multi_dot([np.eye(4), *row.T_node_next[:middle]])
    turned = 0.5 * 1e6 * ARM * 0.0025 / (EI + 1e6 * ARM**2 * 0.5)
    assert np.arctan2(T[1, 0], T[0, 0]) == pytest.approx(turned, abs=1e-3)


def test_what_cannot_be_used_is_refused_with_the_reason():
    factor = factor_of(robot())
    with pytest.raises(MeasurementError, match='no b2; it names a1, a2, b1'):
        factor.row(pulled(0, 1.0, 2.0, 3.0, names=NAMES[:3]))
    with pytest.raises(MeasurementError, match='not finite'):
        factor.row(pulled(0, 1.0, np.nan, 3.0, 4.0))


def test_no_factor_without_a_block_or_where_it_is_switched_off():
    bare = robot().model_copy(update={'actuation': None})
    off = parse_settings(EstimatorSettings, {'mechanics': {'enabled': False}})
    for description, settings in ((bare, EstimatorSettings()), (robot(), off)):
        names = [one.name for one in SlidingWindowFilter(description, None, settings).factors]
        assert 'mechanics' not in names
