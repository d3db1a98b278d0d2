"""
Gauss-Newton on a window.

A solve gives all offsets at once. A column that moved far is linearised anew, together with the
intervals that touch it; the others keep their normal equations, and the chain keeps its
elimination up to the first that changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from continuum_loc.errors import SingularError
from continuum_loc.estimator.factors import Factor
from continuum_loc.estimator.interpolation import blended_step
from continuum_loc.estimator.state import Column, NODE_DIM, POSE_PART
from continuum_loc.estimator.window import Window
import numpy as np

DAMPING_LIMIT = 1e4
# Relative: associations change between iterations, so costs compare only so well.
COST_SLACK = 1e-3


def track(window: Window, time: float | None = None) -> tuple[int, bool]:
    """
    Iterate from next to the minimum: (iterations, whether it converged).

    `time`: the newest instant that will be asked for; by default that of the newest column.
    The columns around it are judged by the body there: ahead of the data the newest one swings
    from iteration to iteration with the weight of its step, and nobody hears of it.
    Raises SingularError.
    """
    first, limit = len(window.intervals), window.settings.solver.max_iterations
    for iteration in range(1, limit + 1):
        first = min(first, _linearise(window))
        offsets = _solve(window, first, 0.0)
        move = _largest_move(window, offsets, time)
        first = _move(window, offsets)
        if move < window.settings.solver.tolerance or first == len(window.intervals):
            return iteration, True  # what was linearised where it is, is solved exactly
    return limit, False


def acquire(window: Window, narrow: Callable[[int], bool]) -> tuple[int, bool]:
    """
    Iterate from a guess, damped whenever the cost rises: (iterations, whether it converged).

    narrow(iteration) tightens the association before each iteration; True once it is as tight
    as when tracking.
    """
    damping, limit = 0.0, window.settings.solver.acquisition_iterations
    for iteration in range(1, limit + 1):
        tight = narrow(iteration)
        first = 0 if damping > 0.0 else len(window.intervals)
        first = min(first, _linearise(window))
        columns, offsets, cost = window.columns.copy(), window.offsets.copy(), _cost(window)
        try:
            solved = _solve(window, first, damping)
        except SingularError:
            damping = max(10.0 * damping, 1e-4)
            continue
        move = _largest_move(window, solved)
        _move(window, solved)
        _linearise(window)
        if _cost(window) > cost * (1.0 + COST_SLACK) + 1.0:
            _undo(window, columns, offsets)
            damping = max(10.0 * damping, 1e-3)
        elif move < window.settings.solver.tolerance and tight:
            break
        else:
            damping = 0.1 * damping if damping > 1e-3 else 0.0
        if damping > DAMPING_LIMIT:
            break
    _linearise(window)
    _solve(window, 0, 0.0)  # the covariance must not know of the damping
    return iteration, iteration < limit and damping <= DAMPING_LIMIT


def from_a_guess(window: Window, factors: Sequence[Factor]) -> tuple[int, bool]:
    """Solve a window from a guess, matching widely at first: (iterations, whether converged)."""

    def loosen(iteration: int) -> bool:
        """Match as widely as befits an iteration; True once as while tracking."""
        moved = [factor.loosen(iteration) for factor in factors]
        if any(moved):
            window.mark_changed()
        return all(factor.tight for factor in factors)

    try:
        return acquire(window, loosen)
    finally:
        for factor in factors:
            factor.loosen(0)


def _solve(window: Window, first: int, damping: float) -> list[np.ndarray]:
    return window.chain.solve([interval.normal for interval in window.intervals], first, damping)


def _linearise(window: Window) -> int:
    """Linearise the intervals that changed; the first of them."""
    changed = [k for k, interval in enumerate(window.intervals) if interval.changed]
    for k in changed:
        window.intervals[k].linearise(window.priors, window.columns[k], window.columns[k + 1])
    return changed[0] if changed else len(window.intervals)


def _move(window: Window, offsets: list[np.ndarray]) -> int:
    """Take the offsets, relinearise columns that moved far; the first interval affected."""
    first = len(window.intervals)
    moves = np.abs(_by_node(window, offsets)[:, :, POSE_PART]).max(axis=(1, 2))
    if window.grid.frames:
        frames = np.array(offsets)[:, window.grid.frame_rows]
        moves = np.maximum(moves, np.abs(frames).max(axis=1))
    far = moves >= window.settings.solver.relinearise
    for k, offset in enumerate(offsets):
        if (k == 0 and window.pinned) or not far[k]:
            window.offsets[k] = offset
            continue
        window.columns[k] = window.columns[k].retract(offset)
        window.offsets[k] = np.zeros(window.grid.dim)
        if k == 0:
            window.linearise_start()
        for touched in (k - 1, k):
            if 0 <= touched < len(window.intervals):
                window.intervals[touched].changed = True
                first = min(first, touched)
    return first


def _undo(window: Window, columns: list[Column], offsets: list[np.ndarray]) -> None:
    """Back to where a failed step started."""
    moved = [old is not new for old, new in zip(columns, window.columns, strict=True)]
    window.columns, window.offsets = columns, offsets
    for k, interval in enumerate(window.intervals):
        interval.changed = interval.changed or moved[k] or moved[k + 1]
    if moved[0]:
        window.linearise_start()


def _largest_move(window: Window, offsets: list[np.ndarray], time: float | None = None) -> float:
    """Largest pose component [m, rad] of the step to these offsets, up to `time`."""
    step = _by_node(window, offsets) - _by_node(window, window.offsets)
    pose = step[:, :, POSE_PART]
    if time is not None:
        k = window.knot_before(time)
        a, b = window.columns[k].time, window.columns[k + 1].time
        pose = pose[: k + 2]
        pose[k + 1] = blended_step(step[k], step[k + 1], b - a, time - a)
    return float(np.abs(pose).max())


def _by_node(window: Window, offsets: list[np.ndarray]) -> np.ndarray:
    """(K, N, 18) offsets of the columns' nodes."""
    nodes = np.array(offsets)[:, : window.grid.bias_offset]
    return nodes.reshape(len(offsets), -1, NODE_DIM)


def _cost(window: Window) -> float:
    """Robust cost where linearised, and by the quadratic model at the offsets."""
    start, x = window.chain.marginals[0], window.offsets[0]
    total = float(start.g @ x) + start.half_square(x)
    return total + sum(
        interval.modelled_cost(window.offsets[k], window.offsets[k + 1])
        for k, interval in enumerate(window.intervals)
    )
