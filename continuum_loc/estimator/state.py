"""
The state on its grid of times and arclengths.

A *column* is the whole body at one knot time: N nodes of {T_map_body, strain, velocity}, a gyro
bias for each IMU, and where the frame lies in which a carried base is measured (F = 1, else 0).
Its tangent vector has 18 N + 3 I + 6 F entries: node n at 18 n as [pose 6, strain 6, velocity 6],
then the biases, then the frame. Pose perturbations act on the right.
"""

from __future__ import annotations

from typing import NamedTuple

from continuum_loc import lie, lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.estimator import gp
from continuum_loc.robot import RobotDescription
import numpy as np

TIME_EPSILON = 1e-9  # [s] stamps are integer nanoseconds
NODE_DIM = 18
STEP_LENGTH = 0.004  # [m] over which strain may step at a module's end
POSE, STRAIN, VELOCITY = 0, 6, 12  # offsets of a node's parts
POSE_PART, STRAIN_PART, VELOCITY_PART = slice(0, 6), slice(6, 12), slice(12, 18)


class Grid:
    """
    Where the nodes are: at the base, every ring and the tip, at module ends, and in between.

    At a module end there are two, before and behind the step of its strain; in between, nodes are
    no farther apart than `spacing`.

    s: (N,) arclengths [m]; steps: (N - 1,) whether strain may step in a segment; ring_nodes:
    (R + 1,) nodes of the base and of the rings; biases: number of IMUs; frames: 1 where the base
    is measured, else 0; dim: length of a column's tangent vector.
    """

    def __init__(self, robot: RobotDescription, spacing: float):
        before = np.array(robot.backbone.module_ends)
        behind = before + STEP_LENGTH
        anchors = np.unique(
            np.concatenate([[0.0], robot.ring_arclengths, before, behind, [robot.length]])
        )
        if anchors[-1] - anchors[-2] < 1e-6:
            anchors = np.delete(anchors, -2 if len(anchors) > 2 else -1)
        pieces = [
            np.linspace(a, b, int(np.ceil((b - a) / spacing - 1e-9)), endpoint=False)
            for a, b in zip(anchors[:-1], anchors[1:], strict=True)
        ]
        self.s = np.concatenate([*pieces, anchors[-1:]])
        self.steps = np.isin(self.s[1:], behind)
        self.ring_nodes = np.array([self.node_at(s) for s in (0.0, *robot.ring_arclengths)])
        self.nodes = len(self.s)
        self.biases = len(robot.imu)
        self.frames = int(robot.base.mode == 'measured')
        self.bias_offset = NODE_DIM * self.nodes
        self.frame_offset = self.bias_offset + 3 * self.biases
        self.dim = self.frame_offset + 6 * self.frames
        self.frame_rows = slice(self.frame_offset, self.dim)

    def node_at(self, s: float) -> int:
        """Return the node at arclength s [m]; every ring has one."""
        return int(np.argmin(np.abs(self.s - s)))

    def segments(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Find the nodes (m,) below arclengths s (m,) and the distances (m,) from them [m].

        s is clipped to the body.
        """
        n = np.clip(np.searchsorted(self.s, s, side='right') - 1, 0, self.nodes - 2)
        return n, np.clip(s, self.s[0], self.s[-1]) - self.s[n]

    def segment(self, s: float) -> tuple[int, float]:
        """`segments` of one arclength."""
        n, offset = self.segments(np.array([s]))
        return int(n[0]), float(offset[0])


class Column(NamedTuple):
    """
    The body at one knot.

    time [s] since the epoch, T (N, 4, 4), strain (N, 6), velocity (N, 6), bias (I, 3),
    T_map_frame (F, 4, 4).
    """

    time: float
    T: np.ndarray
    strain: np.ndarray
    velocity: np.ndarray
    bias: np.ndarray
    T_map_frame: np.ndarray

    def retract(self, delta: np.ndarray) -> Column:
        """Move the column by a tangent vector (18 N + 3 I + 6 F,)."""
        moved = Column(self.time, *(part.copy() for part in self[1:]))
        _retract(moved, delta)
        return moved

    def predict(self, dt: float) -> Column:
        """Predict the column dt later at constant body-frame velocity: the prior's mean."""
        return Column(
            self.time + dt,
            self.T @ lie.exp(dt * self.velocity),
            self.strain.copy(),
            self.velocity.copy(),
            self.bias.copy(),
            self.T_map_frame.copy(),
        )


@kernel
def _retract(column, delta):
    """Move a column of one's own in place."""
    step, moved = np.empty((4, 4)), np.empty((4, 4))
    nodes, biases = column.T.shape[0], column.bias.shape[0]
    for n in range(nodes):
        first = NODE_DIM * n
        lie_kernels.exp(delta[first:][:6], step)
        lie_kernels.compose(column.T[n], step, moved)
        column.T[n] = moved
        for i in range(6):
            column.strain[n, i] += delta[first + STRAIN + i]
            column.velocity[n, i] += delta[first + VELOCITY + i]
    for m in range(biases):
        for i in range(3):
            column.bias[m, i] += delta[NODE_DIM * nodes + 3 * m + i]
    for f in range(column.T_map_frame.shape[0]):
        first = frame_row(column)
        lie_kernels.exp(delta[first:][:6], step)
        lie_kernels.compose(column.T_map_frame[f], step, moved)
        column.T_map_frame[f] = moved


@kernel
def frame_row(column):
    """First of the six rows of a column's frame."""
    return NODE_DIM * column.T.shape[0] + 3 * column.bias.shape[0]


@kernel
def ends_in_time(a, b, n):
    """Two states of node n, at the columns a and b, as the process in time connects them."""
    return gp.Ends(a.T[n], a.velocity[n], b.T[n], b.velocity[n], b.time - a.time)


@kernel
def ends_along(T, rate, s, n):
    """Nodes n and n + 1 at arclengths s (N,) with strain or velocity `rate` (N, 6)."""
    return gp.Ends(T[n], rate[n], T[n + 1], rate[n + 1], s[n + 1] - s[n])


@kernel
def rows_in_time(n, dim, index):
    """Rows (24,) of the `Ends` of `ends_in_time` in an interval's two columns of `dim`."""
    for i in range(6):
        index[i] = NODE_DIM * n + POSE + i
        index[6 + i] = NODE_DIM * n + VELOCITY + i
        index[12 + i] = dim + index[i]
        index[18 + i] = dim + index[6 + i]


@kernel
def rows_along(n, part, index):
    """Rows (24,) of the `Ends` of `ends_along` in a column; part: STRAIN or VELOCITY."""
    for i in range(6):
        index[i] = NODE_DIM * n + POSE + i
        index[6 + i] = NODE_DIM * n + part + i
        index[12 + i] = NODE_DIM + index[i]
        index[18 + i] = NODE_DIM + index[6 + i]


def shape_from_strain(T_map_base: np.ndarray, s: np.ndarray, strain: np.ndarray) -> np.ndarray:
    """
    Poses (N, 4, 4) at s (N,) by integrating strain (N, 6) from the base.

    dT/ds = T eps^, midpoint rule.
    """
    T = np.empty((len(s), 4, 4))
    T[0] = T_map_base
    steps = lie.exp(0.5 * (strain[1:] + strain[:-1]) * np.diff(s)[:, None])
    for n, step in enumerate(steps):
        T[n + 1] = T[n] @ step
    return T


def column_at_rest(
    grid: Grid,
    T_map_base: np.ndarray,
    strain: np.ndarray,
    time: float,
    bias: np.ndarray | None = None,
    T_map_frame: np.ndarray | None = None,
) -> Column:
    """
    Make a motionless column with the given strain (N, 6).

    Gyro biases (I, 3) are none and T_map_frame (F, 4, 4) is `map` where they are not given.
    """
    return Column(
        time,
        shape_from_strain(T_map_base, grid.s, strain),
        strain.copy(),
        np.zeros_like(strain),
        np.zeros((grid.biases, 3)) if bias is None else bias.copy(),
        np.tile(np.eye(4), (grid.frames, 1, 1)) if T_map_frame is None else T_map_frame.copy(),
    )
