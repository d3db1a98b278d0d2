"""
Normal equations, and adding to them in compiled loops.

A quadratic 1/2 x^T H x + g^T x of the offsets x from a linearisation point. Of the symmetric H the
upper triangle alone is kept and the rest is zero, so that the rows `index` to which something is
added come in increasing order.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.compiling import kernel
import numpy as np


class Normal(NamedTuple):
    """H (n, n), its upper triangle, and g (n,)."""

    H: np.ndarray
    g: np.ndarray

    @classmethod
    def zeros(cls, size: int) -> Normal:
        return cls(np.zeros((size, size)), np.zeros(size))

    def clear(self) -> None:
        half = len(self.g) // 2
        self.H[:half].fill(0.0)
        self.H[half:, half:].fill(0.0)  # left of it nothing was added
        self.g.fill(0.0)

    def half_square(self, x: np.ndarray) -> float:
        """x^T H x / 2 (x (n,))."""
        return float(x @ (self.H @ x) - 0.5 * (np.diagonal(self.H) @ np.square(x)))


def symmetric(H: np.ndarray) -> np.ndarray:
    """Whole of a symmetric matrix whose upper triangle H (n, n) is."""
    return H + np.triu(H, 1).T


@kernel
def new_normal(size):
    return Normal(np.zeros((size, size)), np.zeros(size))


@kernel
def add_rows(normal, index, e, J, weights):
    """Add sum_i weights_i (e_i + J_i x)^2 / 2 at the rows `index`; the squared error."""
    H, g = normal.H, normal.g
    squared = 0.0
    for i in range(e.shape[0]):
        weight = weights[i]
        squared += weight * e[i] * e[i]
        for j in range(index.shape[0]):
            scaled = weight * J[i, j]
            if scaled == 0.0:
                continue
            g[index[j]] += scaled * e[i]
            for k in range(j, index.shape[0]):
                H[index[j], index[k]] += scaled * J[i, k]
    return squared


@kernel
def gather(total, local, J, work):
    """
    Add a local quadratic (m), chained through J (m, n), to `total` (n); work (m, n).

    H of `local` is a whole matrix. For many measurements of the same states, before one `scatter`.
    """
    m, n = J.shape
    for i in range(m):
        for j in range(n):
            work[i, j] = 0.0
        for k in range(m):
            weight = local.H[i, k]
            for j in range(n):
                work[i, j] += weight * J[k, j]
    for j in range(n):
        for i in range(m):
            slope = J[i, j]
            if slope == 0.0:
                continue
            total.g[j] += slope * local.g[i]
            for k in range(j, n):
                total.H[j, k] += slope * work[i, k]


@kernel
def gather_rows(total, e, J):
    """Add |e + J x|^2 / 2 to `total`, before one `scatter`."""
    for i in range(e.shape[0]):
        for j in range(J.shape[1]):
            slope = J[i, j]
            if slope == 0.0:  # as rotation is by all translation
                continue
            total.g[j] += slope * e[i]
            for k in range(j, J.shape[1]):
                total.H[j, k] += slope * J[i, k]


@kernel
def scatter(normal, index, total, weight):
    """Add `total` times a weight at the rows `index` (n,), and clear it."""
    n = index.shape[0]
    for j in range(n):
        normal.g[index[j]] += weight * total.g[j]
        total.g[j] = 0.0
        for k in range(j, n):
            normal.H[index[j], index[k]] += weight * total.H[j, k]
            total.H[j, k] = 0.0
