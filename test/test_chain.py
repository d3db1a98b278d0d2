"""The chain against dense algebra: solutions, covariances, marginals."""

from continuum_loc.errors import SingularError
from continuum_loc.estimator.chain import BLOCK, Chain, Cholesky
from continuum_loc.estimator.normal import Normal, symmetric
import numpy as np
import pytest
from scipy.linalg import solve_triangular

D, K = 7, 6


def random_chain(seed: int):
    rng = np.random.default_rng(seed)
    intervals = []
    for _ in range(K - 1):
        A = rng.normal(size=(4 * D, 2 * D))
        intervals.append(Normal(np.triu(A.T @ A), rng.normal(size=2 * D)))
    A = rng.normal(size=(2 * D, D))
    return Normal(np.triu(A.T @ A), rng.normal(size=D)), intervals


def dense(start, intervals):
    size = D * (len(intervals) + 1)
    H, g = np.zeros((size, size)), np.zeros(size)
    H[:D, :D] += symmetric(start.H)
    g[:D] += start.g
    for k, block in enumerate(intervals):
        at = slice(D * k, D * (k + 2))
        H[at, at] += symmetric(block.H)
        g[at] += block.g
    return H, g


@pytest.mark.parametrize('seed', range(3))
def test_solution_and_covariances_equal_dense_algebra(seed):
    start, intervals = random_chain(seed)
    H, g = dense(start, intervals)
    chain = Chain(D, start)
    np.testing.assert_allclose(
        np.concatenate(chain.solve(intervals, 0)), np.linalg.solve(H, -g), atol=1e-9
    )
    P = np.linalg.inv(H)
    A, B = np.random.default_rng(seed).normal(size=(2, 4, D))
    for k in range(K - 1):
        pair = slice(D * k, D * (k + 2))
        both = np.concatenate([A, B], axis=1)
        np.testing.assert_allclose(
            chain.covariance(k, A, B), both @ P[pair, pair] @ both.T, atol=1e-9
        )
        alone = slice(D * k, D * (k + 1))
        np.testing.assert_allclose(chain.covariance(k, A), A @ P[alone, alone] @ A.T, atol=1e-9)


@pytest.mark.parametrize('size', [1, BLOCK - 1, BLOCK, BLOCK + 1, 4 * BLOCK - 3])
def test_solving_by_blocks_is_as_exact_as_solving_row_by_row(size):
    """Scales from metres to strains and gyro biases, with many directions hardly observed."""
    rng = np.random.default_rng(size)
    A = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-3.0, 3.0, size)
    H = A.T @ A + 1e-9 * np.diag(np.sum(A * A, axis=0))
    L, B = np.linalg.cholesky(H), rng.normal(size=(size, 5))
    X = Cholesky(np.asfortranarray(L)).whiten(B)
    # Backward error, the measure of a stable solver: L X = B to rounding of its largest terms.
    assert np.abs(L @ X - B).max() <= 1e-13 * size * (np.abs(L) @ np.abs(X) + np.abs(B)).max()
    expected = solve_triangular(L, B, lower=True)
    np.testing.assert_allclose(X, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_marginalising_equals_the_batch_solution():
    """Sliding a window of three columns over a linear problem ends where the whole batch does."""
    start, intervals = random_chain(7)
    H, g = dense(start, intervals)
    batch = np.linalg.solve(H, -g)
    chain, window = Chain(D, start), []
    for block in intervals:
        window.append(block)
        offsets = chain.solve(window, len(window) - 1)
        if len(window) == 3:
            chain.make_oldest_ready(window[0], changed=False)
            chain.forget_oldest()
            del window[0]
    np.testing.assert_allclose(offsets[-1], batch[-D:], atol=1e-9)


def test_half_a_square_is_that_of_the_whole_matrix():
    rng = np.random.default_rng(9)
    A, x = rng.normal(size=(2 * D, D)), rng.normal(size=D)
    assert Normal(np.triu(A.T @ A), x).half_square(x) == pytest.approx(0.5 * x @ A.T @ A @ x)


def test_kept_marginals_change_nothing():
    start, intervals = random_chain(3)
    chain = Chain(D, start)
    chain.solve(intervals, 0)
    intervals[3] = Normal(intervals[3].H * 1.5, intervals[3].g + 1.0)
    np.testing.assert_allclose(
        chain.solve(intervals, 3), Chain(D, start).solve(intervals, 0), atol=1e-10
    )


def test_an_unobserved_direction_is_said():
    start, intervals = random_chain(1)
    start.H[:] = 0.0
    intervals[0].H[0, :] = intervals[0].H[:, 0] = 0.0
    with pytest.raises(SingularError, match='column 0'):
        Chain(D, start).solve(intervals, 0)


def test_quadratic_form_of_the_inverse_equals_dense_algebra():
    start, intervals = random_chain(5)
    chain = Chain(D, start)
    chain.solve(intervals, 0)
    C = np.random.default_rng(6).normal(size=(K, D, 3))
    flat = C.reshape(K * D, 3)
    expected = flat.T @ np.linalg.solve(dense(start, intervals)[0], flat)
    np.testing.assert_allclose(chain.quadratic(C), expected, rtol=1e-9)


def coupled_by_neighbours(size: int) -> np.ndarray:
    """Right-hand sides as a column's neighbours give them: zero down to a step that goes down."""
    rng = np.random.default_rng(size)
    B = rng.normal(size=(size, size))
    return np.where(np.arange(size)[:, None] >= np.arange(size) - 20, B, 0.0)


@pytest.mark.parametrize('size', [BLOCK + 1, 4 * BLOCK - 3])
def test_zeros_above_a_right_hand_side_are_left_out_and_stay_zeros(size):
    rng = np.random.default_rng(size)
    L = np.linalg.cholesky(np.eye(size) + np.cov(rng.normal(size=(size, 3 * size))))
    B = coupled_by_neighbours(size)
    for right in (B, B[:, ::-1].copy(), B * (np.arange(size) % 3 > 0)):
        X = Cholesky(np.asfortranarray(L)).whiten(right)
        np.testing.assert_allclose(X, solve_triangular(L, right, lower=True), atol=1e-12)
        above = np.maximum.accumulate(right != 0.0, axis=0)
        blocks = np.repeat(np.arange(-(-size // BLOCK)), BLOCK)[:size]
        for k in range(1, blocks[-1] + 1):
            reached = above[blocks <= k].any(axis=0)
            assert not X[blocks < k][:, ~above[blocks < k].any(axis=0) & reached].any()


def test_covariances_of_groups_are_those_of_all_together():
    start, intervals = random_chain(8)
    chain = Chain(D, start)
    chain.solve(intervals, 0)
    A, B = np.random.default_rng(8).normal(size=(2, 6, D))
    whole = chain.covariance(1, A, B)
    apart = chain.covariance(1, A, B, size=2, step=2)
    sliding = chain.covariance(1, A, B, size=4, step=2)
    for groups, size in ((apart, 2), (sliding, 4)):
        for i, found in enumerate(groups):
            at = slice(2 * i, 2 * i + size)
            np.testing.assert_allclose(found, whole[at, at], atol=1e-12)
    assert len(apart) == 3 and len(sliding) == 2
