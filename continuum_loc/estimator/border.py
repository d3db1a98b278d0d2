"""
What measurements say of constants of the robot, beside its motion: a border of the chain.

Let theta (P,) be constants in which the robot may depart from its description (`parameters`). An
interval's quadratic is then one of [x_a; x_b; theta], of which its `Normal` is the part of x and
a `Border` the rest. With the chain's information Lambda of all columns x, eliminating these leaves

    information  H - C^T Lambda^-1 C,    gradient  g + C^T x

of theta, x being the chain's solution with theta as it is; and x moves by -Lambda^-1 C per theta.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc.compiling import kernel
import numpy as np


class Border(NamedTuple):
    """C (n, P) couples n offsets with the constants; H (P, P) and g (P,) are theirs alone."""

    C: np.ndarray
    H: np.ndarray
    g: np.ndarray

    @classmethod
    def zeros(cls, offsets: int, constants: int) -> Border:
        return cls(
            np.zeros((offsets, constants)), np.zeros((constants, constants)), np.zeros(constants)
        )

    def add(
        self,
        rows: np.ndarray,
        J: np.ndarray,
        columns: np.ndarray,
        D: np.ndarray,
        W: np.ndarray,
        e: np.ndarray,
    ) -> None:
        """
        Add |e + J x + D theta|^2 / 2, weighted by W (m, m), at `rows` of x and `columns` of theta.

        e: (m,); J: (m, len(rows)); D: (m, len(columns)). A column of -1 is left out.
        """
        known = columns >= 0
        columns, D = columns[known], D[:, known]
        weighted = W @ D
        self.C[np.ix_(rows, columns)] += J.T @ weighted
        self.H[np.ix_(columns, columns)] += D.T @ weighted
        self.g[columns] += e @ weighted

    def level(self, columns: np.ndarray) -> None:
        """
        Count some constants (places in theta) from their mean, which then nothing is said of.

        A common lateness is no more than another time. That it seems to show, in the linearised
        equations, is what they miss: the motion's prior resists a shift of a motion as it would
        resist that motion once more.
        """
        if not len(columns):
            return
        for part in (self.C, self.H, self.H.T, self.g[None]):
            part[:, columns] -= part[:, columns].mean(axis=1, keepdims=True)


@kernel
def add_local(border, rows, J, columns, M, local):
    """
    Add a local quadratic (m,) of a pose and more, at `columns` (p,) of the constants.

    The pose moves by J (6, len(rows)) times the offsets, and all that `local` is of by M (m, p)
    times the constants; H of `local` is a whole matrix. A column of -1 is left out.
    """
    m, p = M.shape
    HM = np.zeros((m, p))
    for i in range(m):
        for k in range(m):
            weight = local.H[i, k]
            if weight != 0.0:
                for j in range(p):
                    HM[i, j] += weight * M[k, j]
    for j in range(p):
        at = columns[j]
        if at < 0:
            continue
        for i in range(m):
            slope = M[i, j]
            if slope == 0.0:
                continue
            border.g[at] += slope * local.g[i]
            for k in range(p):
                if columns[k] >= 0:
                    border.H[at, columns[k]] += slope * HM[i, k]
        for r in range(rows.shape[0]):
            coupled = 0.0
            for i in range(6):
                coupled += J[i, r] * HM[i, j]
            border.C[rows[r], at] += coupled
