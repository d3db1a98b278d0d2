"""Where a trajectory is known, what lies between two of its instants, and bands of its errors."""

from dataclasses import FrozenInstanceError

from continuum_loc import lie
from continuum_loc.errors import TrajectoryError
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import TruthSample
from continuum_loc.offline.metrics import drift_band, Errors, nees
from continuum_loc.trajectory import known_at, Trajectory
import numpy as np
import pytest

MILLISECOND = 1_000_000
NAMES = ('base', 'tip')


def test_an_instant_is_known_on_a_sample_and_in_short_gaps():
    """Gaps of 0.1, 0.2, 0.21 and 0.9 s, of which 0.2 s is the longest that may be bridged."""
    reference = MILLISECOND * np.array([1000, 1100, 1300, 1510, 2410])
    asked = MILLISECOND * np.array([999, 1000, 1050, 1200, 1300, 1400, 1510, 2000, 2410, 2411])
    known = known_at(reference, asked, 0.2)
    assert known.tolist() == [False, True, True, True, True, False, True, False, True, False]


@pytest.mark.parametrize('count', [0, 1])
def test_fewer_than_two_samples_know_nothing(count):
    assert not known_at(np.full(count, 5), np.array([4, 5, 6]), 0.2).any()


def test_covariance_between_two_samples_goes_linearly_in_time():
    """A quarter of the way from 4 to 8 is 5; poses go along the geodesic."""
    twist = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.8])
    T = np.stack([np.stack([np.eye(4), lie.exp(k * twist)]) for k in range(2)])
    covariance = np.array([4.0, 8.0])[:, None, None, None] * np.tile(np.eye(6), (2, 2, 1, 1))
    track = Trajectory(np.array([0, 100]), NAMES, T, covariance)
    found, P = track.rings_at(np.array([25, 0, 100]), np.array([1, 1, 1]))
    np.testing.assert_allclose(found[0], lie.exp(0.25 * twist), atol=1e-12)
    np.testing.assert_allclose(np.diagonal(P, axis1=1, axis2=2)[:, 0], [5.0, 4.0, 8.0])


def test_a_trajectory_of_one_instant_is_that_everywhere():
    track = Trajectory(np.array([7]), NAMES, np.tile(np.eye(4), (1, 2, 1, 1)))
    T, P = track.rings_at(np.array([7]), np.array([0]))
    np.testing.assert_array_equal(T[0], np.eye(4))
    assert not P.any()


def test_a_truth_of_another_body_is_named_with_its_time():
    samples = [TruthSample(1_234_000_000, np.tile(np.eye(4), (3, 1, 1)))]
    with pytest.raises(TrajectoryError, match=r'the truth at 1\.234 s holds 3 poses'):
        Trajectory.from_truth(samples, NAMES[1:])


def test_a_covariance_without_an_extent_judges_nothing():
    """Of a variance of zero no error is so many sigmas: nan, as of a negative one."""
    flat = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    found = nees(np.ones((3, 6)), np.stack([np.zeros((6, 6)), flat, np.eye(6)]))
    np.testing.assert_array_equal(np.isnan(found), [True, True, False])
    assert found[2] == pytest.approx(6.0)


def test_the_band_is_three_roots_of_the_summed_variances():
    """Sigmas of 1, 2 and 2 mm are 3 mm together; of 0.2, 0.3 and 0.6 deg 0.7 deg."""
    sigma = np.concatenate([[0.001, 0.002, 0.002], np.radians([0.2, 0.3, 0.6])])
    blank = np.zeros((1, 2))
    found = Errors(
        np.array([0]),
        NAMES,
        blank,
        blank,
        np.zeros((1, 2, 6)),
        np.stack([np.zeros((1, 6)), sigma[None]], axis=1),
        blank,
    )
    translation, rotation = drift_band(found, 1)
    assert translation[0] == pytest.approx(0.009)
    assert rotation[0] == pytest.approx(2.1)


def test_maps_and_trajectories_do_not_change():
    track = Trajectory.empty(NAMES)
    prior = PriorMap(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    with pytest.raises(FrozenInstanceError):
        track.stamps = np.zeros(1)
    with pytest.raises(FrozenInstanceError):
        prior.sigma = 0.1
