"""Errors against evo's, consistency against its distributions, trajectories against files."""

from continuum_loc import lie
from continuum_loc.errors import TrajectoryError
from continuum_loc.measurements import NANOSECONDS, TruthSample
from continuum_loc.offline.metrics import drift_band, Errors, errors, nees, summarise
from continuum_loc.trajectory import associate, load_tum, save_tum, Trajectory
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

NAMES = ('base', 'ring1', 'ring2')
START = 1_700_000_000 * NANOSECONDS + 123_456_789


def smooth_truth(count: int = 200, period: float = 0.01) -> Trajectory:
    """Move a body whose rings have constant body velocities, so that geodesics are exact."""
    twists = np.array(
        [[0, 0, 0, 0, 0, 0], [0.1, 0.02, 0, 0, 0.3, 0.1], [0.2, -0.1, 0.05, 0.2, 0.5, -0.7]], float
    )
    times = np.arange(count) * period
    T_map_ring = lie.exp(times[:, None, None] * twists)
    T_map_ring[..., 0, 3] += np.array([0.0, 0.3, 0.6])
    return Trajectory(START + np.round(times * NANOSECONDS).astype(np.int64), NAMES, T_map_ring)


def noisy(truth: Trajectory, covariance: np.ndarray, seed: int) -> Trajectory:
    """`truth` perturbed so that xi = Log(T_est^-1 T_true) is N(0, covariance)."""
    draw = np.random.default_rng(seed).multivariate_normal(
        np.zeros(6), covariance, truth.T_map_ring.shape[:2]
    )
    T_est = truth.T_map_ring @ lie.exp(-draw)
    return Trajectory(
        truth.stamps, truth.names, T_est, np.broadcast_to(covariance, (*T_est.shape[:2], 6, 6))
    )


def random_covariance(seed: int) -> np.ndarray:
    root = (
        np.random.default_rng(seed).normal(size=(6, 6))
        * np.array([5, 5, 5, 20, 20, 20])[:, None]
        * 1e-3
    )
    return root @ root.T + 1e-8 * np.eye(6)


def test_errors_agree_with_evo(tmp_path):
    from evo.core import metrics as evo_metrics
    from evo.core.sync import associate_trajectories
    from evo.tools.file_interface import read_tum_trajectory_file

    truth = smooth_truth()
    estimate = noisy(truth, random_covariance(0), seed=1)
    save_tum(truth, tmp_path, 'truth')
    save_tum(estimate, tmp_path, 'estimate')
    ours = summarise(errors(estimate, truth))['rings']['ring2']
    pair = associate_trajectories(
        read_tum_trajectory_file(tmp_path / 'truth_ring2.tum'),
        read_tum_trajectory_file(tmp_path / 'estimate_ring2.tum'),
        max_diff=1e-4,
    )
    relations = {
        'translation': evo_metrics.PoseRelation.translation_part,
        'rotation': evo_metrics.PoseRelation.rotation_angle_deg,
    }
    for kind, unit in (('translation', 'm'), ('rotation', 'deg')):
        ape = evo_metrics.APE(relations[kind])
        ape.process_data(pair)
        theirs = ape.get_all_statistics()
        assert ours[f'{kind}_mae_{unit}'] == pytest.approx(theirs['mean'], abs=1e-6)
        assert ours[f'{kind}_rmse_{unit}'] == pytest.approx(theirs['rmse'], abs=1e-6)


def test_known_offset_is_reported_exactly():
    truth = smooth_truth()
    shift = lie.exp(np.array([0.003, 0.0, 0.004, 0.0, 0.0, np.radians(2.0)]))
    shift[:3, 3] = [0.003, 0.0, 0.004]
    moved = truth.T_map_ring.copy()
    moved[:, 2] = moved[:, 2] @ shift
    figures = summarise(errors(Trajectory(truth.stamps, NAMES, moved), truth))
    assert figures['rings']['ring2']['translation_mae_m'] == pytest.approx(0.005, abs=1e-12)
    assert figures['rings']['ring2']['rotation_rmse_deg'] == pytest.approx(2.0, abs=1e-9)
    assert figures['rings']['ring1']['translation_mae_m'] == pytest.approx(0.0, abs=1e-12)
    # Over both rings, without the base.
    assert figures['translation_mae_m'] == pytest.approx(0.0025, abs=1e-12)
    assert np.isnan(figures['nees_per_dof'])  # no covariance was given, and none is invented


def test_honest_covariance_gives_unit_nees_and_95_percent_coverage():
    covariance = random_covariance(3)
    figures = summarise(
        errors(noisy(smooth_truth(4000, 0.001), covariance, seed=4), smooth_truth(4000, 0.001))
    )
    # 8000 poses: NEES/6 has mean 1, deviation sqrt(2/6/8000) = 0.0065; coverage 0.95 +- 0.0024.
    # Bounds at 5 sigma, false alarm below 1e-6.
    assert figures['nees_per_dof'] == pytest.approx(1.0, abs=0.033)
    assert figures['coverage_95'] == pytest.approx(0.95, abs=0.0125)


def test_overconfident_covariance_is_told():
    truth, covariance = smooth_truth(2000, 0.001), random_covariance(5)
    estimate = noisy(truth, covariance, seed=6)
    proud = Trajectory(estimate.stamps, NAMES, estimate.T_map_ring, estimate.covariance / 9.0)
    figures = summarise(errors(proud, truth))
    assert figures['nees_per_dof'] == pytest.approx(9.0, rel=0.1)
    assert figures['coverage_95'] < 0.35  # P(chi2_6 <= 12.59 / 9) = 0.034


def test_nees_of_an_indefinite_covariance_is_nan_and_counts_as_not_covered():
    broken = np.eye(6)
    broken[0, 0] = -1.0
    both = np.stack([np.eye(6), broken])
    values = nees(np.ones((2, 6)), both)
    assert values[0] == pytest.approx(6.0)
    assert np.isnan(values[1])
    blank = np.zeros((1, 2, 6))
    found = Errors(
        np.array([0]),
        ('base', 'ring1'),
        np.zeros((1, 2)),
        np.zeros((1, 2)),
        blank,
        blank,
        np.array([[0.0, np.nan]]),
    )
    assert summarise(found)['invalid_covariances'] == 1


def test_three_sigma_band_holds_the_error_as_often_as_a_gaussian_does():
    covariance = random_covariance(8)
    found = errors(noisy(smooth_truth(3000, 0.001), covariance, seed=9), smooth_truth(3000, 0.001))
    translation_band, rotation_band = drift_band(found, 2)
    # The worst case (one direction holds all the variance) leaves 0.27 % outside.
    assert np.mean(found.translation_m[:, 2] > translation_band) < 0.01
    assert np.mean(found.rotation_deg[:, 2] > rotation_band) < 0.01


def test_truth_is_interpolated_along_the_geodesic():
    dense = smooth_truth(201, 0.005)
    sparse = dense.select(np.arange(201) % 10 == 0)
    matched, reference = associate(dense, sparse)
    assert len(matched) == 201
    np.testing.assert_allclose(reference.T_map_ring, dense.T_map_ring, atol=1e-12)


def test_instants_without_truth_are_left_out():
    truth = smooth_truth(100, 0.01)
    gap = truth.select((np.arange(100) < 20) | (np.arange(100) >= 60))
    late = Trajectory(truth.stamps + 5 * NANOSECONDS, NAMES, truth.T_map_ring)
    assert len(associate(late, truth)[0]) == 0
    # The 40 samples inside the gap of 0.41 s go.
    assert len(associate(truth, gap, longest_gap=0.2)[0]) == 60
    assert np.isnan(summarise(errors(late, truth))['translation_mae_m'])


def test_bodies_with_other_rings_are_refused():
    truth = smooth_truth()
    with pytest.raises(TrajectoryError, match='different bodies.*tip'):
        associate(Trajectory(truth.stamps, ('base', 'ring1', 'tip'), truth.T_map_ring), truth)


def test_stamps_must_increase_and_shapes_must_match():
    truth = smooth_truth(3)
    with pytest.raises(TrajectoryError, match='increase'):
        Trajectory(truth.stamps[::-1], NAMES, truth.T_map_ring)
    with pytest.raises(TrajectoryError, match='T_map_ring has shape'):
        Trajectory(truth.stamps, NAMES[:2], truth.T_map_ring)


def test_truth_samples_are_put_in_order():
    samples = [
        TruthSample(stamp, np.tile(np.eye(4) * 1.0, (3, 1, 1))) for stamp in (30, 10, 20, 10)
    ]
    assert Trajectory.from_truth(samples, NAMES[1:]).stamps.tolist() == [10, 20, 30]
    with pytest.raises(TrajectoryError, match='holds 3 poses; this robot has 2: base, ring1'):
        Trajectory.from_truth(samples, NAMES[1:2])


@given(
    st.lists(st.integers(0, 4 * 10**18), min_size=1, max_size=5, unique=True),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=40, deadline=None)
def test_tum_files_keep_every_nanosecond_and_pose(tmp_path_factory, stamps, seed):
    folder = tmp_path_factory.mktemp('tum')
    poses = lie.exp(np.random.default_rng(seed).normal(size=(len(stamps), 3, 6)))
    track = Trajectory(np.array(sorted(stamps), np.int64), NAMES, poses)
    save_tum(track, folder, 'estimate')
    back = load_tum(folder, 'estimate', NAMES)
    np.testing.assert_array_equal(back.stamps, track.stamps)
    np.testing.assert_allclose(back.T_map_ring, track.T_map_ring, atol=1e-10)


def test_a_broken_tum_file_is_named(tmp_path):
    for name in NAMES:
        (tmp_path / f'truth_{name}.tum').write_text('1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 1\n')
    with pytest.raises(TrajectoryError, match=r'truth_base\.tum.*8 numbers'):
        load_tum(tmp_path, 'truth', NAMES)
    with pytest.raises(TrajectoryError, match=r'nowhere_base\.tum: cannot be read'):
        load_tum(tmp_path, 'nowhere', NAMES)
