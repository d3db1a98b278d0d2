"""
Least squares on a chain of columns: block-tridiagonal elimination, marginals, covariances.

Interval k couples columns k and k + 1 by a `Normal` of [x_k; x_k+1], the columns' offsets from
their linearisation points. Eliminating columns from the oldest to the newest leaves on each its
*marginal* (Lambda, eta): all that the past says of it, again a `Normal`.

    S_k = Lambda_k + H_aa,
    Lambda_k+1 = H_bb - H_ab^T S_k^-1 H_ab,   eta_k+1 = g_b - H_ab^T S_k^-1 (eta_k + g_a).

Sliding the window on is therefore exact marginalisation: drop the oldest interval and keep the
marginal that it left. Marginals before the first interval that changed are kept from the last
solve, and covariances come from the same triangular factors (`Cholesky`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from continuum_loc.compiling import kernel
from continuum_loc.errors import SingularError
from continuum_loc.estimator.border import Border
from continuum_loc.estimator.normal import Normal
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import blas, lapack

BLOCK = 54  # rows of a factor that are solved at once: three nodes
Step = tuple[int, slice]


class Cholesky:
    """
    Lower factor L (D, D) of a positive definite matrix L L^T, and solving with it.

    Many right-hand sides are solved by blocks of L's rows: a product with what is solved, then one
    with the inverse of the small diagonal block. Products run at two to three times the speed of
    BLAS's triangular solver at these sizes, and blocks this small lose nothing in accuracy. A
    right-hand side stays zero down to its first block that is not, so that the blocks above are
    left out: a node is coupled with its neighbours alone, which makes most right-hand sides half
    zero.
    """

    __slots__ = ('L', '_inverses')

    def __init__(self, L: np.ndarray):
        self.L = L
        self._inverses: list[np.ndarray] | None = None

    def whiten(self, B: np.ndarray, steps: list[Step] | None = None) -> np.ndarray:
        """L^-1 B (D, m), with B's `steps_of` where they are known."""
        starts = range(0, len(self.L), BLOCK)
        rows = [slice(at, at + BLOCK) for at in starts]
        if self._inverses is None:
            self._inverses = [lapack.dtrtri(self.L[block, block], lower=1)[0] for block in rows]
        X = np.zeros(B.shape)
        for top, columns in steps_of(B) if steps is None else steps:
            for k in range(top // BLOCK, len(rows)):
                rest, above = B[rows[k], columns], slice(top, starts[k])
                if starts[k] > top:
                    rest = rest - self.L[rows[k], above] @ X[above, columns]
                np.matmul(self._inverses[k], rest, out=X[rows[k], columns])
        return X

    def unwhiten(self, B: np.ndarray) -> np.ndarray:
        """L^-T B (D, m)."""
        return blas.dtrsm(1.0, self.L, B, lower=1, trans_a=1)

    def lower(self, b: np.ndarray) -> np.ndarray:
        """L^-1 b (D,)."""
        return blas.dtrsv(self.L, b, lower=1)

    def upper(self, b: np.ndarray) -> np.ndarray:
        """L^-T b (D,)."""
        return blas.dtrsv(self.L, b, lower=1, trans=1)


@dataclass(slots=True, eq=False)
class _Elimination:
    """One eliminated column: S's factor, Y = L^-1 H_ab with its steps, y = L^-1 (eta + g_a)."""

    factor: Cholesky
    Y: np.ndarray
    y: np.ndarray
    steps: list[Step]

    def passed_on(self, X: np.ndarray) -> np.ndarray:
        """Y^T X (D, m): what right-hand sides become at the next column, but for the sign."""
        out = np.zeros((self.Y.shape[1], X.shape[1]))
        for top, columns in self.steps:
            np.matmul(self.Y[top:, columns].T, X[top:], out=out[columns])
        return out


class Chain:
    """Elimination of a window's intervals, with what can be kept from one solve to the next."""

    def __init__(self, dim: int, start: Normal):
        self.dim = dim
        self.marginals = [start]
        self.border: Border | None = None  # of the oldest column, where constants are estimated
        self._eliminated: list[_Elimination] = []
        self._last: tuple[Cholesky, np.ndarray] | None = None

    def solve(
        self, intervals: list[Normal], first_changed: int, damping: float = 0.0
    ) -> list[np.ndarray]:
        """Offsets (D,) of all columns. Raises SingularError."""
        self._forward(intervals, first_changed, damping)
        factor, y = self._last
        offsets = [-factor.upper(y)]
        for step in reversed(self._eliminated):
            offsets.append(-step.factor.upper(step.y + step.Y @ offsets[-1]))
        return offsets[::-1]

    def covariance(
        self,
        column: int,
        A: np.ndarray,
        B: np.ndarray | None = None,
        size: int | None = None,
        step: int | None = None,
    ) -> np.ndarray:
        """
        Covariance (m, m) of A x + B x', with the offsets x of a column and x' of the next one.

        A, B: (m, D). With `size`, those (G, size, size) of groups of so many rows, which begin
        every `step` rows. With the chain's factor C (C C^T = H) it is X^T X, X = C^-1 [A B]^T, and
        X is zero above `column`: the cost grows with the columns after it, not with the window.
        """
        groups = (size or len(A), step or len(A))
        X = self._factor(column).whiten(np.ascontiguousarray(A.T))
        covariance = _squares(X, *groups)
        for k in range(column + 1, len(self._eliminated) + 1):
            right = -self._eliminated[k - 1].passed_on(X)
            if B is not None and k == column + 1:
                right += B.T
            X = self._factor(k).whiten(right)
            covariance += _squares(X, *groups)
        return covariance if size else covariance[0]

    def quadratic(self, C: np.ndarray) -> np.ndarray:
        """
        C^T H^-1 C (S, S) for C (K, D, S) over all columns, with H the chain's information.

        It takes one forward substitution.
        """
        return sum(y.T @ y for y in self.whiten(C))

    def whiten(self, C: Sequence[np.ndarray]) -> list[np.ndarray]:
        """L^-1 C (K of (D, S)) for C (K, D, S) over all columns: L L^T = H."""
        out, right = [], C[0]
        for k in range(len(C)):
            out.append(self._factor(k).whiten(right))
            if k + 1 < len(C):
                right = C[k + 1] - self._eliminated[k].passed_on(out[-1])
        return out

    def unwhiten(self, Z: Sequence[np.ndarray]) -> list[np.ndarray]:
        """L^-T Z (K of (D, S)): with `whiten` before it, H^-1 C."""
        out = [self._factor(len(Z) - 1).unwhiten(Z[-1])]
        for k in range(len(Z) - 2, -1, -1):
            out.append(self._factor(k).unwhiten(Z[k] - self._eliminated[k].Y @ out[-1]))
        return out[::-1]

    def _factor(self, column: int) -> Cholesky:
        if column < len(self._eliminated):
            return self._eliminated[column].factor
        return self._last[0]

    def make_oldest_ready(self, oldest: Normal, changed: bool) -> None:
        """
        Eliminate the oldest column through its interval, where that has not been done.

        `changed` says that the interval is not the one of the last solve.
        """
        if changed or not self._eliminated:
            self.marginals[1:], self._eliminated[:] = [], []
            self._eliminate(oldest, 0, 0.0)

    def forget_oldest(self) -> None:
        """Marginalise the oldest column: the next one's marginal becomes the start."""
        del self.marginals[0], self._eliminated[0]

    def pass_on(self, older: np.ndarray, newer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Carry columns C (D, S) of the oldest column on to the next, as its elimination does.

        older, newer: C at either. Returns C at the newer one, and Z = L^-1 C of the older.
        """
        step = self._eliminated[0]
        Z = step.factor.whiten(older)
        return newer - step.passed_on(Z), Z

    @property
    def oldest(self) -> np.ndarray:
        """L^-1 (eta + g_a) (D,) of the oldest column, as its elimination left it."""
        return self._eliminated[0].y

    def _forward(self, intervals: list[Normal], first: int, damping: float) -> None:
        first = min(first, len(self._eliminated))
        kept = first + 1
        del self.marginals[kept:], self._eliminated[first:]
        for k in range(first, len(intervals)):
            self._eliminate(intervals[k], k, damping)
        newest = self.marginals[-1]
        factor = _factored(newest.H, damping, len(intervals))
        self._last = (factor, factor.lower(newest.g))

    def _eliminate(self, interval: Normal, k: int, damping: float) -> None:
        D, (H, g), marginal = self.dim, interval, self.marginals[k]
        factor = _factored(marginal.H + H[:D, :D], damping, k)
        steps = steps_of(H[:D, D:])
        Y = factor.whiten(H[:D, D:], steps)
        y = factor.lower(marginal.g + g[:D])
        information = blas.dsyrk(-1.0, Y.T, beta=1.0, c=H[D:, D:].T, lower=1).T
        self._eliminated.append(_Elimination(factor, Y, y, steps))
        self.marginals.append(Normal(information, g[D:] - Y.T @ y))


def _factored(S: np.ndarray, damping: float, column: int) -> Cholesky:
    """Factor a matrix given by its upper triangle."""
    if damping > 0.0:
        S = S + damping * np.diag(np.diag(S))
    L, info = lapack.dpotrf(S.T, lower=1, clean=1)  # by columns, as LAPACK has it
    if info != 0 or not np.isfinite(L[-1, -1]):
        raise SingularError(column)
    return Cholesky(L)


def _squares(X: np.ndarray, size: int, step: int) -> np.ndarray:
    """X_i^T X_i (G, size, size) of each `size` columns X_i of X that begin every `step`."""
    apart = size == step and X.shape[1] % size == 0  # and so without numpy's slow windows
    groups = (
        X.reshape(len(X), -1, size) if apart else sliding_window_view(X, size, axis=1)[:, ::step]
    )
    return groups.transpose(1, 2, 0) @ groups.transpose(1, 0, 2)


def steps_of(B: np.ndarray) -> list[Step]:
    """
    Where the columns of B (D, m) begin: (first row of a block, columns zero in all rows above).

    Columns that begin later than one to their right count as beginning with that one.
    """
    reaches = [0, *_reaches(B, BLOCK).tolist()]
    return [
        (BLOCK * k, slice(a, b))
        for k, (a, b) in enumerate(zip(reaches[:-1], reaches[1:], strict=True))
        if b > a
    ]


@kernel
def _reaches(B, rows):
    """Columns of B (D, m) up to the last that is not zero in each block of `rows` or above."""
    blocks = (B.shape[0] + rows - 1) // rows
    reaches, reach = np.empty(blocks, np.int64), 0
    for k in range(blocks):
        for i in range(k * rows, min((k + 1) * rows, B.shape[0])):
            last = B.shape[1]
            while last > reach and B[i, last - 1] == 0.0:
                last -= 1
            reach = last
        reaches[k] = reach
    return reaches
