"""
Static equilibrium of a rod with tendons, weight, loads and dry friction.

The rod is cut into N elements of constant strain, q (N, 4) = [stretch - 1, twist, bend y, bend z]:
a Kirchhoff rod that may stretch. Its equilibrium is the least potential energy

    sum_i h_i/2 (q - q_rest)' K (q - q_rest)  +  tendons  +  friction  -  work of the loads.

A tendon runs parallel to the backbone at the offset r = (0, r_y, r_z) from the base to its end. On
an element its path is h (1 + stretch + bend_y r_z - bend_z r_y): linear in q. (The twist of the
rod enters by its square, (r twist)^2 / 2, which is left out.) It pulls with k x where its end has
to stretch it by x > 0, and with nothing where it is slack.

Friction in the body is dry: the bending may depart from where it last slid by limit / stiffness,
then it slides. Over a step of time the potential of that is the Huber function, so that a step of
a recording with hysteresis is an equilibrium like any other (`slide` moves the memory after it).

An element's strain is q plus the change of bending along it that the loads beyond it demand,
u' = n x t / EI. That change turns the element's end by nothing and moves it aside by
h^3 / (12 EI) n: an element shears as if it had the stiffness 12 EI / h^2. So shapes are of fourth
order in the element's length, with no unknowns beside q.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from continuum_loc import lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.lie_kernels import SCRATCH, TWIST
import numpy as np

STRETCH, TWISTING, BEND = 0, 1, 2  # columns of q; bending takes two
TOLERANCE = 1e-9  # of the residual, against the stiffness's own scale
MOST_STEPS = 60
LEAST_SHARE = 1e-4  # of a Newton step
SOFTENING = 2e-5  # [m] over which a tendon goes slack


class Rod(NamedTuple):
    """
    N elements from base to tip.

    spans: (N,) lengths [m]. stiffness: (N, 4) EA [N], GJ, EI, EI [N m^2]; infinite where it does
    not give. rest: (N, 4) strain without load. friction: (N, 2) of the bending: stiffness [N m^2]
    until it slides, and the moment [N m] at which it does.
    """

    spans: np.ndarray
    stiffness: np.ndarray
    rest: np.ndarray
    friction: np.ndarray


class Tendons(NamedTuple):
    """
    M tendons on N elements.

    path: (M, N, 4) what a unit of strain adds to a tendon's path [m]. stiffness: (M,) of the
    tendon between motor and end [N/m]. taken: (M,) length that the motor has wound up beyond that
    at which the straight tendon is just taut [m]; negative where it hangs. tension: (M,) given,
    beside what `taken` makes [N].
    """

    path: np.ndarray
    stiffness: np.ndarray
    taken: np.ndarray
    tension: np.ndarray


class Load(NamedTuple):
    """
    Dead loads in the map frame.

    force (N + 1, 3) [N] and moment (N + 1, 3) [N m] at the elements' ends, base first; weight (3,)
    [N/m] along the whole rod.
    """

    force: np.ndarray
    moment: np.ndarray
    weight: np.ndarray


class Balance(NamedTuple):
    """Where forces balance, or how far from it: poses, residual, its derivative, tensions."""

    T: np.ndarray  # (N + 1, 4, 4) T_map_node
    residual: np.ndarray  # (4 N,)
    tangent: np.ndarray  # (4 N, 4 N)
    pull: np.ndarray  # (M,) tensions [N]
    twists: np.ndarray  # (N, 6) from end to end of each element
    motions: np.ndarray  # (N, 4, 6) twist of the map of all beyond an element, by its strain
    twist: np.ndarray  # (1,) and
    scratch: np.ndarray  # (1,) room for the kernels of the group


def no_load(elements: int) -> Load:
    return Load(np.zeros((elements + 1, 3)), np.zeros((elements + 1, 3)), np.zeros(3))


def no_tendons(elements: int) -> Tendons:
    return Tendons(np.zeros((0, elements, 4)), np.zeros(0), np.zeros(0), np.zeros(0))


def new_balance(elements: int, tendons: int) -> Balance:
    size = 4 * elements
    return Balance(
        np.zeros((elements + 1, 4, 4)),
        np.zeros(size),
        np.zeros((size, size)),
        np.zeros(tendons),
        np.zeros((elements, 6)),
        np.zeros((elements, 4, 6)),
        np.zeros(1, TWIST),
        np.zeros(1, SCRATCH),
    )


def paths(
    spans: np.ndarray, ends: np.ndarray, angles: np.ndarray, radii: np.ndarray
) -> np.ndarray:
    """
    (M, N, 4) `Tendons.path` of tendons that end at arclengths `ends` (M,), at angles (M,) [rad].

    An element that a tendon passes in part counts by that part. Offsets are radius (0, cos, sin).
    """
    outer = np.cumsum(spans)
    inner = outer - spans
    within = np.clip(ends[:, None] - inner, 0.0, spans)
    y, z = radii * np.cos(angles), radii * np.sin(angles)
    per_metre = np.stack([np.ones_like(y), np.zeros_like(y), z, -y], axis=1)
    return np.ascontiguousarray(within[:, :, None] * per_metre[:, None, :])


@kernel
def _nodal_force(rod, load, i, f):
    """Force at the end of element i: what is put there, and the weight of half its neighbours."""
    half = 0.5 * rod.spans[i] + (0.5 * rod.spans[i + 1] if i + 1 < rod.spans.shape[0] else 0.0)
    for k in range(3):
        f[k] = load.force[i + 1, k] + half * load.weight[k]


@kernel
def place(rod, load, q, T, twist):
    """
    Poses (N + 1, 4, 4) of the elements' ends, the base's T[0] being given.

    twist: (N, 6) of each element, with its shear.
    """
    count = rod.spans.shape[0]
    F, f, half, step = np.zeros(3), np.empty(3), np.zeros(6), np.empty((4, 4))
    for i in range(count):
        _nodal_force(rod, load, i, f)
        F += f
    for i in range(count):
        h, xi = rod.spans[i], twist[i]
        for c in range(3):
            xi[3 + c] = h * q[i, 1 + c]
            half[3 + c] = 0.5 * xi[3 + c]
        xi[0] = h * (1.0 + q[i, 0])
        lie_kernels.exp(half, step)
        lie_kernels.compose(T[i], step, T[i + 1])
        for c in range(1, 3):
            aside = 0.0
            for k in range(3):
                aside += T[i + 1, k, c] * F[k]
            xi[c] = h**3 / (12.0 * rod.stiffness[i, 1 + c]) * aside
        lie_kernels.exp(xi, step)
        lie_kernels.compose(T[i], step, T[i + 1])
        _nodal_force(rod, load, i, f)
        F -= f


@kernel
def _motions(rod, balance):
    """Motion (N, 4, 6) of the map that all beyond an element makes by a unit of its strain."""
    twist, scratch, out = balance.twist[0], balance.scratch[0], balance.motions
    left, Ad = np.empty((6, 6)), np.empty((6, 6))
    for i in range(rod.spans.shape[0]):
        h = rod.spans[i]
        for c in range(6):
            twist.x[c] = -balance.twists[i, c]  # J_l(x) = J_r(-x)
        lie_kernels.right_coefficients(twist.x, twist.c, twist.dc)
        lie_kernels.ad(twist.x, twist.ad)
        lie_kernels.polynomial(twist.c, twist.ad, left, scratch.blocks)
        lie_kernels.adjoint(balance.T[i], Ad)
        for c in range(4):
            column = 0 if c == 0 else 2 + c
            for row in range(6):
                total = 0.0
                for k in range(6):
                    total += Ad[row, k] * left[k, column]
                out[i, c, row] = h * total


@kernel
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def _add_loads(rod, load, motions, balance):
    """
    Work of the loads: its gradient exactly, its second derivative for a chain of rotations.

    A point p beyond two elements a <= b moves by w_a x (v_b + w_b x p) to second order; within an
    element the two orders are averaged.
    """
    count = rod.spans.shape[0]
    F, M, G = np.zeros(3), np.zeros(3), np.zeros((3, 3))  # sum f, sum p x f, sum p f'
    f, lever, arm, moved = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(count - 1, -1, -1):
        _nodal_force(rod, load, i, f)
        p = balance.T[i + 1, :3, 3]
        _cross(p, f, lever)
        for k in range(3):
            F[k] += f[k]
            M[k] += lever[k] + load.moment[i + 1, k]
            for m in range(3):
                G[k, m] += p[k] * f[m]
        trace = G[0, 0] + G[1, 1] + G[2, 2]
        for c in range(4):
            own = motions[i, c]
            for k in range(3):
                balance.residual[4 * i + c] -= own[k] * F[k] + own[3 + k] * M[k]
            # (v x F + sum (w x p) x f), on which the rotation of an inner element acts
            _cross(own[:3], F, arm)
            for k in range(3):
                moved[k] = arm[k] - trace * own[3 + k]
                for m in range(3):
                    moved[k] += G[k, m] * own[3 + m]
            for j in range(i + 1):
                for d in range(4):
                    value = 0.0
                    for k in range(3):
                        value += motions[j, d, 3 + k] * moved[k]
                    if j == i:
                        balance.tangent[4 * i + c, 4 * i + d] -= 0.5 * value
                        balance.tangent[4 * i + d, 4 * i + c] -= 0.5 * value
                    else:
                        balance.tangent[4 * i + c, 4 * j + d] -= value
                        balance.tangent[4 * j + d, 4 * i + c] -= value


@kernel
def _add_own_weight(rod, load, q, balance):
    """
    Add what the weight of an element does on its own bow, which the chord of its ends leaves out.

    By Simpson's rule two thirds of it hang at the middle, h^2/8 (u x t) below the chord.
    """
    if not np.any(load.weight):
        return
    down = np.empty(2)
    for i in range(rod.spans.shape[0]):
        R, share = balance.T[i + 1, :3, :3], rod.spans[i] ** 3 / 12.0
        for c in range(2):
            down[c] = 0.0
            for k in range(3):
                down[c] += R[k, 1 + c] * load.weight[k]
        balance.residual[4 * i + 2] -= share * down[1]
        balance.residual[4 * i + 3] += share * down[0]


@kernel
def _add_elastic(rod, q, memory, balance):
    """Elastic moments, and those of friction about the strain (N, 2) where it last slid."""
    for i in range(rod.spans.shape[0]):
        h = rod.spans[i]
        for c in range(4):
            stiffness = rod.stiffness[i, c]
            if math.isinf(stiffness):
                continue
            balance.residual[4 * i + c] += h * stiffness * (q[i, c] - rod.rest[i, c])
            balance.tangent[4 * i + c, 4 * i + c] += h * stiffness
        stiffness, limit = rod.friction[i, 0], rod.friction[i, 1]
        if stiffness <= 0.0:
            continue
        a, b = q[i, 2] - memory[i, 0], q[i, 3] - memory[i, 1]
        off = math.sqrt(a * a + b * b)
        if stiffness * off <= limit:
            along, across = stiffness, stiffness
        else:
            along, across = 0.0, limit / off
        at = 4 * i + 2
        balance.residual[at] += h * across * a
        balance.residual[at + 1] += h * across * b
        if off > 0.0:
            a, b = a / off, b / off
        balance.tangent[at, at] += h * (across + (along - across) * a * a)
        balance.tangent[at + 1, at + 1] += h * (across + (along - across) * b * b)
        balance.tangent[at, at + 1] += h * (along - across) * a * b
        balance.tangent[at + 1, at] += h * (along - across) * a * b


@kernel
def _add_tendons(tendons, q, balance):
    """Pull of the tendons."""
    size = balance.residual.shape[0]
    for k in range(tendons.stiffness.shape[0]):
        path = tendons.path[k].reshape(size)
        stretch = tendons.taken[k]
        flat = q.reshape(size)
        for a in range(size):
            stretch += path[a] * flat[a]
        root = math.sqrt(stretch * stretch + SOFTENING * SOFTENING)
        taut = 0.5 * (stretch + root)
        rate = 0.5 * tendons.stiffness[k] * (1.0 + stretch / root)
        balance.pull[k] = tendons.stiffness[k] * taut + tendons.tension[k]
        for a in range(size):
            if path[a] == 0.0:
                continue
            balance.residual[a] += path[a] * balance.pull[k]
            for b in range(size):
                balance.tangent[a, b] += rate * path[a] * path[b]


@kernel
def assemble(rod, tendons, load, memory, q, balance):
    """Residual of the forces at q, its derivative, and the poses, from the base's T[0] on."""
    balance.residual[:] = 0.0
    balance.tangent[:] = 0.0
    place(rod, load, q, balance.T, balance.twists)
    _motions(rod, balance)
    _add_loads(rod, load, balance.motions, balance)
    _add_own_weight(rod, load, q, balance)
    _add_elastic(rod, q, memory, balance)
    _add_tendons(tendons, q, balance)
    for i in range(rod.spans.shape[0]):
        for c in range(4):
            if math.isinf(rod.stiffness[i, c]):
                a = 4 * i + c
                balance.residual[a] = 0.0
                balance.tangent[a, :] = 0.0
                balance.tangent[:, a] = 0.0
                balance.tangent[a, a] = 1.0


@kernel
def factorise(A, damping, L):
    """Cholesky factor L of A with its diagonal raised by a share; False where it has none."""
    n = A.shape[0]
    for j in range(n):
        for i in range(j, n):
            total = A[i, j]
            if i == j:
                total += damping * abs(A[i, i])
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if total <= 0.0:
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@kernel
def solve_factored(L, b):
    """Solve L L' x = b in place."""
    n = L.shape[0]
    for i in range(n):
        for k in range(i):
            b[i] -= L[i, k] * b[k]
        b[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= L[k, i] * b[k]
        b[i] /= L[i, i]


@kernel
def _size(rod, residual):
    """Residual as the square of the strain that it would make alone [1 m]."""
    total = 0.0
    for i in range(rod.spans.shape[0]):
        for c in range(4):
            stiffness = rod.stiffness[i, c]
            if not math.isinf(stiffness):
                total += residual[4 * i + c] ** 2 / (rod.spans[i] * stiffness)
    return total


@kernel
def equilibrium(rod, tendons, load, memory, q, balance):
    """
    Find the equilibrium from the guess q (N, 4), which becomes it; False where it was not reached.

    Newton with halved steps, damped where the tangent is not positive definite. The base's pose
    is balance.T[0].
    """
    count, size = rod.spans.shape[0], balance.residual.shape[0]
    L, step, trial = np.zeros((size, size)), np.empty(size), np.empty((count, 4))
    for i in range(count):
        for c in range(4):
            if math.isinf(rod.stiffness[i, c]):
                q[i, c] = rod.rest[i, c]
    assemble(rod, tendons, load, memory, q, balance)
    error, scale, damping = _size(rod, balance.residual), 0.0, 0.0
    for i in range(count):
        scale += rod.spans[i] * rod.stiffness[i, 2]
    for _ in range(MOST_STEPS):
        if error <= TOLERANCE * TOLERANCE * scale:
            return True
        while not factorise(balance.tangent, damping, L):
            damping = max(10.0 * damping, 1e-6)
        for a in range(size):
            step[a] = -balance.residual[a]
        solve_factored(L, step)
        share, best = 1.0, error
        while True:
            for i in range(count):
                for c in range(4):
                    trial[i, c] = q[i, c] + share * step[4 * i + c]
            assemble(rod, tendons, load, memory, trial, balance)
            error = _size(rod, balance.residual)
            if error < best or share < LEAST_SHARE:
                break
            share *= 0.5
        q[:] = trial
        damping = 0.1 * damping if share == 1.0 else damping
        if damping < 1e-9:
            damping = 0.0
        if share < LEAST_SHARE and error >= best:
            return error <= 1e6 * TOLERANCE * TOLERANCE * scale
    return error <= TOLERANCE * TOLERANCE * scale


@kernel
def slide(rod, q, memory):
    """Move the memory (N, 2) of friction to where the bending q lets it stay."""
    for i in range(rod.spans.shape[0]):
        stiffness, limit = rod.friction[i, 0], rod.friction[i, 1]
        if stiffness <= 0.0:
            continue
        a, b = q[i, 2] - memory[i, 0], q[i, 3] - memory[i, 1]
        off = math.sqrt(a * a + b * b)
        if stiffness * off > limit:
            share = 1.0 - limit / (stiffness * off)
            memory[i, 0] += share * a
            memory[i, 1] += share * b
