"""
The rod's continuous motion, from the states at the time steps.

Poses at the steps are exact. Between them each frame follows the cubic Hermite curve in the local
variable on SE(3), whose velocities at the steps are the mean of the two neighbouring steps'
twists; so velocity is the derivative of pose, everywhere, and every sensor can be sampled at its
own instant.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

from continuum_loc import lie
import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """
    The robot at the end of one time step.

    time: seconds since the trajectory's start. T_map_node: (N + 1, 4, 4). insertion: m.
    tendon_length: (K,) m; tension: (K,) N.
    """

    time: float
    T_map_node: np.ndarray
    insertion: float
    tendon_length: np.ndarray
    tension: np.ndarray


class _Curve(NamedTuple):
    """
    The curve in the local variable from one step to the next, of F frames.

    xi: (F, 6) where the next step lies; v_a, w_b: (F, 6) its derivatives at both ends [1/s].
    """

    xi: np.ndarray
    v_a: np.ndarray
    w_b: np.ndarray

    @classmethod
    def through(cls, twist: np.ndarray, d: float) -> _Curve:
        """Make the curve of the middle of three steps with twists (3, F, 6), of `d` seconds."""
        v_a, v_b = (twist[0] + twist[1]) / 2.0, (twist[1] + twist[2]) / 2.0
        xi = d * twist[1]
        return cls(xi, v_a, np.einsum('fij,fj->fi', lie.right_jacobian_inverse(xi), v_b))

    def at(self, u: float, d: float, frames: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Local variable (F, 6) at the fraction u of the step."""
        xi, v_a, w_b = (part[frames] for part in self)
        return (
            u**2 * (3.0 - 2.0 * u) * xi + u * (1.0 - u) ** 2 * d * v_a - u**2 * (1.0 - u) * d * w_b
        )


class Motion:
    """Four consecutive states; motion is defined between the middle two."""

    def __init__(self) -> None:
        self._states: deque[State] = deque(maxlen=4)
        self._steps: deque[np.ndarray] = deque(maxlen=3)  # (N + 1, 6) from state to state
        self._nodes: _Curve | None = None  # of all nodes in the middle step, once it is asked for

    def append(self, state: State) -> None:
        """Append the next state, one time step after the last."""
        if self._states:
            before = self._states[-1].T_map_node
            self._steps.append(lie.log(lie.inverse(before) @ state.T_map_node))
        self._states.append(state)
        self._nodes = None

    def covers(self, time: float) -> bool:
        """Whether `time` lies between the middle two states."""
        return len(self._states) == 4 and time < self._states[2].time - 1e-9

    def _at(self, time: float) -> tuple[float, float]:
        """Fraction of the middle interval, and its duration [s]."""
        start, end = self._states[1].time, self._states[2].time
        if not start - 1e-9 <= time <= end + 1e-9:
            raise ValueError(f'time {time} s lies outside the stored interval [{start}, {end}] s')
        fraction = (time - start) / (end - start)
        return (0.0 if abs(fraction) < 1e-6 else fraction), end - start

    def frames(self, nodes: np.ndarray, T_node_frame: np.ndarray) -> np.ndarray:
        """(4, F, 4, 4) poses of frames fixed to nodes, at the four states."""
        return np.stack([state.T_map_node[nodes] for state in self._states]) @ T_node_frame

    def pose(self, time: float, nodes: np.ndarray | slice = slice(None)) -> np.ndarray:
        """(F, 4, 4) poses T_map_node of the chosen nodes."""
        (u, d), start = self._at(time), self._states[1].T_map_node[nodes]
        if u == 0.0:
            return start.copy()
        self._nodes = self._nodes or _Curve.through(np.stack(self._steps) / d, d)
        return start @ lie.exp(self._nodes.at(u, d, nodes))

    def kinematics(
        self, time: float, frames: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Pose (F, 4, 4) and acceleration (F, 3) in map, and body twist (F, 6) [v; w], of frames.

        `frames` are the four states of `frames()`. The acceleration is the second difference of
        position, linear between the steps.
        """
        u, d = self._at(time)
        twist = lie.log(lie.inverse(frames[:-1]) @ frames[1:]) / d
        position = frames[..., :3, 3]
        acceleration = np.diff(position, n=2, axis=0) / d**2
        acceleration = (1.0 - u) * acceleration[0] + u * acceleration[1]
        if u == 0.0:
            return frames[1].copy(), (twist[0] + twist[1]) / 2.0, acceleration
        curve = _Curve.through(twist, d)
        gamma = curve.at(u, d)
        rate = (
            6.0 * u * (1.0 - u) * twist[1]
            + (1.0 - u) * (1.0 - 3.0 * u) * curve.v_a
            + u * (3.0 * u - 2.0) * curve.w_b
        )
        return (
            frames[1] @ lie.exp(gamma),
            np.einsum('fij,fj->fi', lie.right_jacobian(gamma), rate),
            acceleration,
        )

    def encoders(self, time: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Read insertion [m], tendon lengths [m] and tensions [N] (K,), linear between steps."""
        u, _ = self._at(time)
        a, b = self._states[1], self._states[2]
        return tuple(
            (1.0 - u) * x + u * y
            for x, y in (
                (a.insertion, b.insertion),
                (a.tendon_length, b.tendon_length),
                (a.tension, b.tension),
            )
        )


def segment_strain(T_map_node: np.ndarray, nodes_s: np.ndarray) -> np.ndarray:
    """
    (N, 6) strain [nu; omega] of each segment: the screw from node to node, per unit of s.

    For pure bending this is the constant-curvature arc that is tangent to both links at their
    middles.
    """
    return lie.log(lie.inverse(T_map_node[:-1]) @ T_map_node[1:]) / np.diff(nodes_s)[:, None]


def backbone(T_map_node: np.ndarray, nodes_s: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) in map of the backbone at s (...) in [0, L], along arcs through nodes."""
    s = np.asarray(s, float)
    if np.any(s < nodes_s[0] - 1e-9) or np.any(s > nodes_s[-1] + 1e-9):
        raise ValueError(
            f'arclength must lie in [{nodes_s[0]}, {nodes_s[-1]}] m, got {s.min()} to {s.max()}'
        )
    segment = np.clip(np.searchsorted(nodes_s, s, side='right') - 1, 0, len(nodes_s) - 2)
    xi = segment_strain(T_map_node, nodes_s)[segment] * (s - nodes_s[segment])[..., None]
    return T_map_node[segment] @ lie.exp(xi)
