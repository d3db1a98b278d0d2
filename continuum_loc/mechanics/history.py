"""
A recording as a chain of equilibria, and how its tip depends on any parameter of the model.

By the implicit function theorem dq = -H^-1 (dr + r_memory d memory): the parameter's own effect
dr is a difference at the same strain, which costs an assembly and no solution, and the memory of
friction carries the slopes from sample to sample.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from continuum_loc.compiling import kernel
from continuum_loc.mechanics.statics import (
    assemble,
    equilibrium,
    factorise,
    Load,
    new_balance,
    Rod,
    slide,
    solve_factored,
    Tendons,
)
import numpy as np


class Model(NamedTuple):
    """
    A robot and what its motors did in S samples.

    tendons.taken is not used, but taken (S, M). T_map_base (4, 4); tip (3,): the marker in the
    frame of the last element's end.
    """

    rod: Rod
    tendons: Tendons
    load: Load
    taken: np.ndarray
    T_map_base: np.ndarray
    tip: np.ndarray


class Reached(NamedTuple):
    """
    An equilibrium of N elements, from which slopes by P parameters are taken.

    memory (N, 2) of the friction before it, q (N, 4) its strain, residual (4 N,) of its balance,
    L (4 N, 4 N) its factored tangent, d_memory (P, N, 2) slopes of the memory.
    """

    memory: np.ndarray
    q: np.ndarray
    residual: np.ndarray
    L: np.ndarray
    d_memory: np.ndarray


class History(NamedTuple):
    """
    What became of it.

    tip: (S, 3) in the map. slope: (S, 3, P) by the parameters. by_strain: (S, 3, 4 N), its slope
    by the strain. strain: (S, N, 4). pull: (S, M).
    reached: (S,) whether the equilibrium was.
    """

    tip: np.ndarray
    slope: np.ndarray
    by_strain: np.ndarray
    strain: np.ndarray
    pull: np.ndarray
    reached: np.ndarray


def stack(models: list[Model]) -> Model:
    """One model whose arrays have the models along a first axis."""

    def join(parts):
        first = parts[0]
        if isinstance(first, np.ndarray):
            return np.ascontiguousarray(np.stack(parts))
        return type(first)(*(join(column) for column in zip(*parts, strict=True)))

    return join(models)


def follow(model: Model, moved: list[Model] = (), step: np.ndarray | None = None) -> History:
    """
    Find the tip at every sample, and its slopes.

    moved: the model with each of P parameters moved by step (P,).
    """
    samples, elements, tendons = len(model.taken), len(model.rod.spans), len(model.taken[0])
    history = History(
        np.zeros((samples, 3)),
        np.zeros((samples, 3, len(moved))),
        np.zeros((samples, 3, 4 * elements)),
        np.zeros((samples, elements, 4)),
        np.zeros((samples, tendons)),
        np.zeros(samples, np.bool_),
    )
    balance = new_balance(elements, tendons)
    if moved:
        _follow(model, stack(list(moved)), np.asarray(step, float), balance, history)
    else:
        _follow(model, stack([model]), np.zeros(0), balance, history)
    return history


@kernel
def _marker(T, tip, out):
    for k in range(3):
        out[k] = T[k, 0] * tip[0] + T[k, 1] * tip[1] + T[k, 2] * tip[2] + T[k, 3]


@kernel
def _follow(model, moved, step, balance, history):
    rod, load, parameters = model.rod, model.load, step.shape[0]
    count, size = rod.spans.shape[0], balance.residual.shape[0]
    q, memory = rod.rest.copy(), rod.rest[:, 2:].copy()
    d_memory, dq = np.zeros((parameters, count, 2)), np.empty((parameters, size))
    L, own = np.zeros((size, size)), np.empty(size)
    for i in range(parameters):  # the memory starts at rest, which may be a parameter itself
        d_memory[i] = (moved.rod.rest[i, :, 2:] - rod.rest[:, 2:]) / step[i]
    balance.T[0] = model.T_map_base
    for t in range(model.taken.shape[0]):
        tendons = Tendons(
            model.tendons.path, model.tendons.stiffness, model.taken[t], model.tendons.tension
        )
        history.reached[t] = equilibrium(rod, tendons, load, memory, q, balance)
        history.strain[t] = q
        history.pull[t] = balance.pull
        _marker(balance.T[count], model.tip, history.tip[t])
        _by_strain(balance, history.tip[t], history.by_strain[t])
        if parameters > 0:
            if not factorise(balance.tangent, 0.0, L):
                factorise(balance.tangent, 1e-6, L)
            own[:] = balance.residual
            reached = Reached(memory, q, own, L, d_memory)
            for i in range(parameters):
                _slope(moved, i, t, step[i], reached, dq[i], balance, history)
                for k in range(3):
                    for a in range(size):
                        history.slope[t, k, i] += history.by_strain[t, k, a] * dq[i, a]
            balance.T[0] = model.T_map_base
            _carry(rod, moved.rod, step, q, memory, dq, d_memory)
        slide(rod, q, memory)


@kernel
def _by_strain(balance, tip, out):
    """Slope (3, 4 N) of the marker at `tip` by the strain."""
    for i in range(balance.motions.shape[0]):
        for c in range(4):
            m = balance.motions[i, c]
            out[0, 4 * i + c] = m[0] + m[4] * tip[2] - m[5] * tip[1]
            out[1, 4 * i + c] = m[1] + m[5] * tip[0] - m[3] * tip[2]
            out[2, 4 * i + c] = m[2] + m[3] * tip[1] - m[4] * tip[0]


@kernel
def _slope(moved, i, t, step, reached, dq, balance, history):
    """Slope dq of the strain by parameter i, and of the marker at the same strain."""
    rod = Rod(moved.rod.spans[i], moved.rod.stiffness[i], moved.rod.rest[i], moved.rod.friction[i])
    tendons = Tendons(
        moved.tendons.path[i],
        moved.tendons.stiffness[i],
        moved.taken[i, t],
        moved.tendons.tension[i],
    )
    memory, q, own = reached.memory, reached.q, reached.residual
    load = Load(moved.load.force[i], moved.load.moment[i], moved.load.weight[i])
    balance.T[0] = moved.T_map_base[i]
    assemble(rod, tendons, load, memory, q, balance)
    _marker(balance.T[rod.spans.shape[0]], moved.tip[i], history.slope[t, :, i])
    for k in range(3):
        history.slope[t, k, i] = (history.slope[t, k, i] - history.tip[t, k]) / step
    for a in range(own.shape[0]):
        dq[a] = (own[a] - balance.residual[a]) / step
    for n in range(rod.spans.shape[0]):
        A, _ = _friction(rod, n, q, memory)
        for c in range(2):
            for d in range(2):
                dq[4 * n + 2 + c] += rod.spans[n] * A[c, d] * reached.d_memory[i, n, d]
    solve_factored(reached.L, dq)


@kernel
def _friction(rod, n, q, memory):
    """Slope (2, 2) of an element's friction moment by its bending, and whether it slides."""
    A = np.zeros((2, 2))
    stiffness, limit = rod.friction[n, 0], rod.friction[n, 1]
    a, b = q[n, 2] - memory[n, 0], q[n, 3] - memory[n, 1]
    off = math.sqrt(a * a + b * b)
    if stiffness <= 0.0 or stiffness * off <= limit:
        A[0, 0] = A[1, 1] = stiffness
        return A, False
    a, b = a / off, b / off
    A[0, 0], A[0, 1] = limit / off * b * b, -limit / off * a * b
    A[1, 0], A[1, 1] = A[0, 1], limit / off * a * a
    return A, True


@kernel
def _carry(rod, moved, step, q, memory, dq, d_memory):
    """Slopes of the memory after `slide`: q - width v / |v|, v = q - memory, where it slides."""
    for n in range(rod.spans.shape[0]):
        A, slides = _friction(rod, n, q, memory)
        if not slides:
            continue
        stiffness, limit = rod.friction[n, 0], rod.friction[n, 1]
        v = q[n, 2:] - memory[n]
        off = math.sqrt(v[0] * v[0] + v[1] * v[1])
        for i in range(step.shape[0]):
            wider = (moved.friction[i, n, 1] / moved.friction[i, n, 0] - limit / stiffness) / step[
                i
            ]
            d0 = dq[i, 4 * n + 2] - d_memory[i, n, 0]
            d1 = dq[i, 4 * n + 3] - d_memory[i, n, 1]
            for c in range(2):
                d_memory[i, n, c] = (
                    dq[i, 4 * n + 2 + c]
                    - (A[c, 0] * d0 + A[c, 1] * d1) / stiffness
                    - wider * v[c] / off
                )
