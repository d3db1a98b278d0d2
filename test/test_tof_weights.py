"""
What one zone is worth to the filter, worked out by hand.

A stiff arm of 0.2 m looks along x from its tip at a wall. It carries one ToF sensor, and the base
is known to 1 mm in every direction and firmly in rotation, so that the tip is a point whose prior
is known. One frame then adds alpha / variance along the wall's normal (paper eqs. 1-3), which is
what 1 / P along the normal grows by.
"""

from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import TofFrame
from continuum_loc.robot import RobotDescription, TofModel
from continuum_loc.settings import parse_settings
import numpy as np
import pytest
from worlds import EXACT

STAMP = 1_000_000_000
LENGTH = 0.2  # [m]
SIGMA_BASE = 1e-3  # [m]
HALF_VIEW = 0.41421356  # tan of half of 45 degrees
WALL = 0.9  # [m] from the tip, where Table I has 0.009 d: halfway from 0.012 d to 0.006 d
SIGMA_WALL = 0.0081
NONE = 1.0  # [1/m^2] what is none: the least sigma here that is one is told to four digits


def arm(zones: int = 1, base: tuple[float, float] = (SIGMA_BASE, 1e-4)) -> RobotDescription:
    """Describe the arm; `base` are the spreads of its base [m, deg]."""
    return parse_settings(
        RobotDescription,
        {
            'name': 'stiff',
            'length': LENGTH,
            'radius': 0.02,
            'base': {'sigma_position': base[0], 'sigma_rotation_deg': base[1]},
            'backbone': {'rest_strain_sigma': [1e-6] * 6},
            'tof_model': {'rows': zones, 'columns': zones},
            'rings': [{'name': 'tip', 's': LENGTH}],
            'tof': [
                {'name': 'eye', 'ring': 'tip', 'mount': {'xyz': [0, 0, 0], 'rpy_deg': [0, 0, 0]}}
            ],
            'tolerances': EXACT,
        },
    )


def normal_at(cosine: float) -> np.ndarray:
    """Give the normal of a wall that a beam along x meets at this cosine; it leans back in z."""
    return np.array([-cosine, 0.0, np.sqrt(1.0 - cosine**2)])


def wall(
    distance: float,
    cosine: float = 1.0,
    sigma: float = 1e-9,
    planarity: tuple[float, float] = (1.0, 1.0),
    reach: float = 0.3,
) -> PriorMap:
    """
    Map a wall through the point at `distance` before the tip, `reach` [m] to every side.

    planarity: (of the wall, of a second one 20 m behind that has twice as many points).
    """
    n = normal_at(cosine)
    across, up = np.array([0.0, 1.0, 0.0]), np.array([n[2], 0.0, -n[0]])
    ticks = np.linspace(-reach, reach, 31)
    u, v = (x.reshape(-1, 1) for x in np.meshgrid(ticks, ticks))
    points = np.array([LENGTH + distance, 0.0, 0.0]) + u * across + v * up
    behind = np.tile(points + np.array([20.0, 0.0, 0.0]), (2, 1)) + np.repeat(
        [[0.0, 0.0, 0.0], [0.005, 0.0, 0.0]], len(points), axis=0
    )
    return PriorMap(
        points=np.concatenate([points, behind]),
        normals=np.tile(n, (3 * len(points), 1)),
        planarity=np.repeat(planarity, [len(points), 2 * len(points)]),
        sigma=sigma,
    )


def estimate(robot, prior_map, ranges, status, **tof):
    """One frame through the filter; no other number of its settings matters here."""
    settings = parse_settings(
        EstimatorSettings,
        {
            'recovery': {'enabled': False},
            'prior': {
                'strain': [1e-9] * 6,
                'initial_velocity_sigma': [1e-6, 1e-6],
                'memory': 1e9,
            },
            'tof': {'floor': 0.0, **tof},
        },
    )
    rays = robot.tof_model.directions
    ranges = np.broadcast_to(np.asarray(ranges, float), len(rays))
    status = np.broadcast_to(np.asarray(status, np.uint8), len(rays))
    frame = TofFrame(STAMP, 'eye', ranges[:, None] * rays, ranges, 0.01 * ranges, status)
    return SlidingWindowFilter(robot, prior_map, settings).process(frame)


def information(prior_map, ranges, status=5, robot=None, cosine=1.0, **tof) -> float:
    """
    Information [1/m^2] along the wall's normal that a frame brings about the tip.

    Against a frame whose noise of 1 km leaves the base's spread; none where it is refused.
    """
    robot, n = robot or arm(), normal_at(cosine)
    before = variance_along(n, estimate(robot, prior_map, ranges, 5, **{**tof, 'floor': 1e3}))
    assert before == pytest.approx(SIGMA_BASE**2, rel=1e-3)
    after = estimate(robot, prior_map, ranges, status, **tof)
    return 0.0 if after is None else 1.0 / variance_along(n, after) - 1.0 / before


def variance_along(direction: np.ndarray, found) -> float:
    """Variance [m^2] of the tip's position; the arm lies along the map's axes."""
    return float(direction @ found.covariance[1, :3, :3] @ direction)


# Table I of the paper. d < 0.025: invalid; 0.025 to 0.6: 0.014 d -> 0.012 d; 0.6 to 1.2: 0.012 d
# -> 0.006 d; beyond 0.006 d; "->" is linear in d.
TABLE_1 = [
    (0.025, 0.000350),
    (0.3125, 0.0040625),  # halfway: 0.013 d
    (0.6, 0.0072),
    (0.75, 0.007875),  # a quarter of the way: 0.0105 d
    (0.9, 0.0081),  # halfway: 0.009 d
    (1.2, 0.0072),
    (2.0, 0.012),
    (4.0, 0.024),
]


@pytest.mark.parametrize(('distance', 'sigma'), TABLE_1)
def test_a_range_is_as_good_as_table_1_says(distance, sigma):
    assert TofModel().sigma(np.array([distance]))[0] == pytest.approx(sigma, rel=1e-12)
    found = information(wall(distance), distance)
    assert found == pytest.approx(1.0 / sigma**2, rel=1e-4)


@pytest.mark.parametrize('distance', [0.0249, 4.001])
def test_a_range_outside_of_table_1_says_nothing(distance):
    assert abs(information(wall(distance), distance)) < NONE


def test_the_sensors_of_the_paper_are_those_of_table_1():
    """8 x 8 zones over 45 deg, up to 4 m, at 15 Hz (paper, IV-C.1), unless a file changes them."""
    model = TofModel()
    assert (model.rows, model.columns, model.fov_deg) == (8, 8, 45.0)
    assert (model.min_range, model.max_range, model.rate) == (0.025, 4.0, 15.0)
    assert model.noise_distance == (0.025, 0.6, 1.2)
    assert model.noise_coefficient == (0.014, 0.012, 0.006)


@pytest.mark.parametrize('status', [6, 9])
def test_a_half_confident_zone_has_twice_the_sigma(status):
    """Status 6 and 9 are right half of the time, and count a quarter."""
    found = information(wall(WALL), WALL, status=status)
    assert found == pytest.approx(0.25 / SIGMA_WALL**2, rel=1e-4)


@pytest.mark.parametrize('status', [0, 1, 2, 3, 4, 7, 8, 10, 11, 12, 13, 14])
def test_other_statuses_say_nothing(status):
    assert information(wall(WALL), WALL, status=status) == pytest.approx(0.0, abs=NONE)


def test_noise_acts_along_the_beam():
    """At 60 degrees of incidence half of it lies across the wall."""
    found = information(wall(WALL, 0.5), WALL, cosine=0.5)
    assert found == pytest.approx(1.0 / (0.5 * SIGMA_WALL) ** 2, rel=1e-4)


def test_the_floor_and_the_maps_sigma_act_across_the_wall():
    """They add to the beam's share: squares of 4.05, 3 and 2 mm."""
    found = information(wall(WALL, 0.5, sigma=0.002), WALL, cosine=0.5, floor=0.003)
    assert found == pytest.approx(1e6 / (4.05**2 + 3.0**2 + 2.0**2), rel=1e-4)


def test_the_maps_sigma_alone_keeps_a_near_zone_from_being_trusted():
    found = information(wall(0.1, sigma=0.005), 0.1)  # Table I: 0.01374 d there
    assert found == pytest.approx(1e6 / (5.0**2 + 1.3739**2), rel=1e-4)


@pytest.mark.parametrize('zones', [1, 8])
def test_the_footprint_is_a_share_of_half_a_zone_on_slanted_walls(zones):
    """
    A zone that integrates over its width sees that much of a slanted wall's depth.

    At distance d half a zone is d tan(22.5 deg) / zones wide; 0.3 of it counts, times the sine of
    incidence.
    """
    robot, cosine = arm(zones), 0.5
    rays, n = robot.tof_model.directions, normal_at(0.5)
    zone = len(rays) // 2 + zones // 2  # of 8 x 8 one of the four in the middle
    incidence = rays[zone] @ n
    distance = WALL * -cosine / incidence  # where its beam meets the wall
    table = np.interp(distance, [0.6, 1.2], [0.012, 0.006]) * distance
    width = 0.3 * distance * HALF_VIEW / zones
    expected = (table * incidence) ** 2 + width**2 * (1.0 - incidence**2) + 0.002**2
    status = np.full(len(rays), 255)
    status[zone] = 5
    found = information(
        wall(WALL, cosine), distance, status, robot, cosine, footprint=0.3, floor=0.002
    )
    assert found == pytest.approx(1.0 / expected, rel=1e-4)


def test_a_wall_that_faces_the_beam_has_no_footprint():
    found = information(wall(WALL), WALL, footprint=1.0)
    assert found == pytest.approx(1.0 / SIGMA_WALL**2, rel=1e-4)


def test_all_zones_of_a_frame_add_up():
    """Seen square on, each zone's distance is WALL over its ray's x."""
    robot = arm(8)
    along = robot.tof_model.directions[:, 0]
    distance = WALL / along
    sigma = np.interp(distance, [0.6, 1.2], [0.012, 0.006]) * distance
    expected = np.sum(1.0 / (sigma * along) ** 2)
    assert information(wall(WALL), distance, robot=robot) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(('power', 'weight'), [(0.0, 1.0), (1.0, 0.5), (2.0, 0.25), (None, 0.5)])
def test_a_wall_half_as_planar_as_the_map_counts_by_the_power_of_it(power, weight):
    """The map's median planarity is 0.8, the wall's 0.4; by default the power is 1."""
    chosen = {} if power is None else {'planarity_power': power}
    found = information(wall(WALL, planarity=(0.4, 0.8)), WALL, **chosen)
    assert found == pytest.approx(weight / SIGMA_WALL**2, rel=1e-4)


def test_no_wall_counts_more_than_whole():
    found = information(wall(WALL, planarity=(1.0, 0.8)), WALL)
    assert found == pytest.approx(1.0 / SIGMA_WALL**2, rel=1e-4)


@pytest.mark.parametrize(
    ('cosine', 'least', 'matched'),
    [(0.16, None, True), (0.14, None, False), (0.14, 0.1, True), (0.5, 0.6, False)],
)
def test_walls_that_the_beam_grazes_are_not_matched(cosine, least, matched):
    """By default below a cosine of 0.15."""
    chosen = {} if least is None else {'min_cosine': least}
    found = information(wall(WALL, cosine), WALL, cosine=cosine, **chosen)
    expected = 1.0 / (SIGMA_WALL * cosine) ** 2 if matched else 0.0
    assert found == pytest.approx(expected, rel=1e-3, abs=NONE)


def test_the_back_of_a_wall_is_not_matched():
    prior_map = wall(WALL)
    turned = PriorMap(
        points=prior_map.points,
        normals=-prior_map.normals,
        planarity=prior_map.planarity,
        sigma=prior_map.sigma,
    )
    assert abs(information(turned, WALL)) < NONE


@pytest.mark.parametrize(('cauchy', 'weight'), [(2.0, 0.5), (1.0, 0.2), (1e6, 1.0)])
def test_a_zone_two_sigmas_off_counts_by_the_cauchy_loss(cauchy, weight):
    """
    Eq. 3 with its scale: 1 / (1 + (2 / c)^2).

    The base is so firm that the residual stays; the loss of the first fit is set alike.
    """
    found = information(
        wall(WALL), WALL + 2.0 * SIGMA_OF_1, cauchy=cauchy, acquisition_cauchy=cauchy
    )
    assert found == pytest.approx(weight / SIGMA_OF_1**2, rel=0.02)


SIGMA_OF_1 = 0.0081162  # of the longer range itself, 0.9162 m: (0.009 - 0.000162) d


def test_a_gate_ends_the_match():
    """1.5 m before a wall at 0.9 m: 0.6 m off, beyond both gates."""
    assert abs(information(wall(WALL), 1.5)) < NONE


def test_the_tip_moves_by_the_gain():
    """
    A wall that seems 2 mm too far draws the tip back by 2 mm P / (P + sigma^2).

    P is 1 mm^2, sigma^2 8.1^2 mm^2 and a little, and the loss is wide.
    """
    robot, prior_map = arm(), wall(WALL)
    moved = estimate(robot, prior_map, WALL + 0.002, 5, cauchy=1e6, acquisition_cauchy=1e6)
    sigma = 0.902 * (0.009 - 0.00002) * 1e3
    expected = [LENGTH - 0.002 / (1.0 + sigma**2), 0.0, 0.0]
    np.testing.assert_allclose(moved.T_map_ring[1, :3, 3], expected, atol=1e-8)


def test_a_slanted_wall_tells_the_pitch_by_its_lever():
    """
    Turning the base by w about y lifts a point 1.1 m ahead by -1.1 w in z.

    Across a wall at 45 degrees that is 1.1 sin(45 deg) w, so that the pitch gains the square of
    this over the zone's variance.
    """
    half = np.sqrt(0.5)
    robot, prior_map = arm(base=(1e-7, 1.0)), wall(WALL, half)
    P = [estimate(robot, prior_map, WALL, 5, floor=f).covariance[1, 4, 4] for f in (1e3, 0.0)]
    assert P[0] == pytest.approx(np.radians(1.0) ** 2, rel=1e-3)
    expected = ((LENGTH + WALL) * half) ** 2 / (SIGMA_WALL * half) ** 2
    assert 1.0 / P[1] - 1.0 / P[0] == pytest.approx(expected, rel=1e-3)
