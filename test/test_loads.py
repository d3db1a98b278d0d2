"""Forces on the body, from a shape that tendons and weight do not explain."""

from continuum_loc.actuation import Actuation
from continuum_loc.estimate import PointLoad
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.measurements import EncoderSample, NANOSECONDS, StrainSample
from continuum_loc.mechanics.body import TendonBody
from continuum_loc.mechanics.statics import equilibrium, new_balance
from continuum_loc.robot import RobotDescription
from continuum_loc.settings import parse_settings
from msg_tools.factory import bag_messages
from msg_tools.records import LoadRecord
from msg_tools.topics import topic_spec
import numpy as np
import pytest

EI, WEIGHT, LENGTH = 1.0, 1.0, 1.0
NAMES = ('up', 'down', 'left')
TENSIONS = np.array([30.0, 0.0, 10.0])


def robot() -> RobotDescription:
    """One metre with weight; three tendons to its end; rings and strain every 10 and 5 cm."""
    tendons = [
        {'name': name, 'end': LENGTH, 'azimuth_deg': angle, 'radius': 0.01}
        for name, angle in zip(NAMES, (90, 270, 0), strict=True)
    ]
    block = Actuation(
        mode='tension',
        tendons=tendons,
        EI=(EI,),
        weight=(0.0, 0.0, -WEIGHT),
        strain_sigma=(0.001, 0.02, 0.02),
    )
    return RobotDescription(
        name='loaded',
        length=LENGTH,
        radius=0.02,
        strain={'spacing': 0.05, 'kappa_sigma': 0.005, 'theta_sigma': 0.005},
        rings=[{'name': f'r{k}', 's': 0.1 * k} for k in range(1, 11)],
        actuation=block,
    )


def strain_under(description: RobotDescription, s: float, force) -> tuple[np.ndarray, np.ndarray]:
    """Bending (M, 2) at the stations, and the place (3,), with a force [N] at arclength s."""
    body = TendonBody(description, np.linspace(0.0, LENGTH, 41))
    balance, q = new_balance(40, 3), body.rod.rest.copy()
    balance.T[0] = np.eye(4)
    load = body.load
    node = round(40 * s)
    load.force[node] = force
    assert equilibrium(body.rod, body.pulled(TENSIONS), load, np.zeros((40, 2)), q, balance)
    stations = description.strain_stations
    bending = np.stack([np.interp(stations, body.s, q[:, c]) for c in (2, 3)], axis=1)
    return bending, balance.T[node, :3, 3]


def loads_under(s: float, force, seconds: float = 1.0) -> tuple[list[PointLoad], np.ndarray]:
    """Return the loads that the filter tells last, and where the force was."""
    description = robot()
    settings = parse_settings(EstimatorSettings, {'strain': {'scale': 1.0}})
    estimator, rng = SlidingWindowFilter(description, None, settings), np.random.default_rng(5)
    bending, place = strain_under(description, s, force)
    estimate = None
    for k in range(round(20 * seconds)):
        stamp = k * NANOSECONDS // 20
        noisy = bending + 0.005 * rng.normal(size=bending.shape)
        theta = np.arctan2(-noisy[:, 0], noisy[:, 1])
        kappa = np.linalg.norm(noisy, axis=1)
        tendons = EncoderSample(stamp, NAMES, np.full(3, np.nan), TENSIONS)
        strain = StrainSample(stamp, description.strain_stations, theta, kappa)
        for sample in (tendons, strain):
            estimate = estimator.process(sample) or estimate
    return list(estimate.loads), place


@pytest.mark.parametrize(
    ('s', 'force'), [(1.0, (0.0, 0.0, 0.5)), (0.7, (0.0, 0.8, 0.0)), (1.0, (0.0, -0.4, -0.4))]
)
def test_a_force_is_found_with_its_size_place_and_direction(s, force):
    found, place = loads_under(s, force)
    first = found[0]
    assert abs(first.s - s) < 0.05
    assert np.linalg.norm(first.force) == pytest.approx(np.linalg.norm(force), rel=0.2)
    off = first.force - force
    assert off @ np.linalg.solve(first.covariance, off) < 16.3  # chi2 of 3 at 0.1 %
    assert np.linalg.norm(first.place - place) < 0.06


def test_where_tendons_and_weight_explain_the_shape_no_force_is_told():
    assert loads_under(1.0, (0.0, 0.0, 0.0))[0] == []


def test_a_force_is_found_within_a_third_of_a_second():
    assert loads_under(1.0, (0.0, 0.0, 0.5), seconds=0.3)[0]


def test_what_is_looked_for_can_be_switched_off():
    settings = parse_settings(EstimatorSettings, {'mechanics': {'loads': False}})
    estimator = SlidingWindowFilter(robot(), None, settings)
    estimator._loads.look(10.0)
    assert estimator._loads.found == ()


def test_a_load_goes_out_as_a_wrench_about_the_maps_origin_and_comes_back():
    spec = topic_spec('load')

    class Told:
        stamp = 5 * NANOSECONDS
        loads = (
            PointLoad(0.5, 0.01, np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 3.0]), np.eye(3)),
        )

    read = spec.decode(spec.encode(bag_messages(), Told()), None, 'load')
    assert isinstance(read, LoadRecord) and np.allclose(read.force, [0.0, 0.0, 3.0])
    assert np.allclose(read.moment, [6.0, -3.0, 0.0])  # (1, 2, 0) x (0, 0, 3)
    Told.loads = ()
    nothing = spec.decode(spec.encode(bag_messages(), Told()), None, 'load')
    assert not nothing.force.any() and not nothing.moment.any()


def test_elements_cut_anywhere_have_the_stretches_own_stiffness():
    description = robot()
    block = description.actuation.model_copy(update={'EI': (1.0, 2.0)})
    description = description.model_copy(
        update={
            'actuation': block,
            'backbone': description.backbone.model_copy(update={'module_ends': (0.5,)}),
        }
    )
    body = TendonBody(description, np.array([0.0, 0.3, 0.6, 1.0]))
    assert body.rod.stiffness[:, 2].tolist() == [1.0, 1.0, 2.0]
