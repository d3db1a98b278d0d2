"""
The frames that others publish: a tree with a little history, and the way from one to another.

What tf2's buffer does, for as much of it as is needed: tf2_ros is not on every machine, and brings
a thread of its own.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator
from threading import Lock

from continuum_loc import lie
from continuum_loc.errors import FrameError
from continuum_loc.measurements import NANOSECONDS, nanoseconds
import numpy as np

KEPT = nanoseconds(10.0)  # of history, as tf2 keeps
MOST_FRAMES = 10_000  # however many names the graph invents
MOST_STAMPS = 10_000


class FrameTree:
    """
    Each frame's parent and its poses in it, by stamp; a fixed one has a pose for all times.

    One thread may add while another asks.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._parents: dict[str, str] = {}
        self._moving: dict[str, deque[tuple[int, np.ndarray]]] = {}
        self._fixed: dict[str, np.ndarray] = {}

    def add(self, parent: str, child: str, T_parent_child: np.ndarray, stamp: int | None) -> None:
        """Note where a frame is in its parent's at a stamp [ns], or always (None)."""
        with self._lock:
            self._add(parent, child, T_parent_child, stamp)

    def _add(self, parent: str, child: str, T_parent_child: np.ndarray, stamp: int | None) -> None:
        if child not in self._parents and len(self._parents) >= MOST_FRAMES:
            return
        if self._parents.get(child, parent) != parent:
            self._moving.pop(child, None)
            self._fixed.pop(child, None)
        self._parents[child] = parent
        if stamp is None:
            self._fixed[child] = T_parent_child
            return
        poses = self._moving.setdefault(child, deque(maxlen=MOST_STAMPS))
        if poses and stamp < poses[-1][0] - KEPT:  # time starts again
            poses.clear()
        if poses and stamp <= poses[-1][0]:
            return
        poses.append((stamp, T_parent_child))
        while poses[-1][0] - poses[0][0] > KEPT:
            poses.popleft()

    def transform(self, target: str, source: str, stamp: int | None = None) -> np.ndarray:
        """
        (4, 4) from `source` to `target` at a stamp [ns]; None for the newest of each frame.

        Raises FrameError where the two are not connected, or not known then.
        """
        with self._lock:
            up, down = dict(self._ascent(source, stamp)), dict(self._ascent(target, stamp))
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            known = ', '.join(sorted({*self._parents, *self._parents.values()})) or 'none'
            raise FrameError(
                f"no way from frame '{source}' to '{target}' on /tf and /tf_static; "
                f'known frames: {known}'
            )
        return lie.inverse(down[common]) @ up[common]

    def latest(self, target: str, source: str) -> int | None:
        """Newest stamp [ns] at which `source` is known in `target`; None where it never moved."""
        with self._lock:
            stamps = [
                self._moving[frame][-1][0]
                for end in (source, target)
                for frame, _ in self._ascent(end, None)
                if frame in self._parents and frame not in self._fixed
            ]
        return min(stamps, default=None)

    def _ascent(self, frame: str, stamp: int | None) -> Iterator[tuple[str, np.ndarray]]:
        """(ancestor, (4, 4) of the frame in it), beginning with the frame itself."""
        T = np.eye(4)
        seen: set[str] = set()
        while True:
            yield frame, T
            seen.add(frame)
            parent = self._parents.get(frame)
            if parent is None or parent in seen:
                return
            T = self._pose(frame, stamp) @ T
            frame = parent

    def _pose(self, child: str, stamp: int | None) -> np.ndarray:
        if child in self._fixed:
            return self._fixed[child]
        poses = self._moving[child]
        if stamp is None:
            return poses[-1][1]
        index = bisect_left(poses, stamp, key=lambda pair: pair[0])
        if index < len(poses) and poses[index][0] == stamp:
            return poses[index][1]
        if not 0 < index < len(poses):
            first, last = (poses[i][0] / NANOSECONDS for i in (0, -1))
            raise FrameError(
                f"frame '{child}' is known from {first:.3f} to {last:.3f} s, "
                f'not at {stamp / NANOSECONDS:.3f} s'
            )
        (before, T_before), (after, T_after) = poses[index - 1], poses[index]
        return lie.interpolate(T_before, T_after, np.array((stamp - before) / (after - before)))
