"""
What the estimator node keeps of the past, in bounded memory.

The newest trajectory, and the scene it saw.
"""

from __future__ import annotations

from collections import deque
from itertools import islice
from pathlib import Path

from continuum_loc.estimate import Estimate
from continuum_loc.mapping.prior_map import PriorMap
from continuum_loc.measurements import nanoseconds, TofFrame
from continuum_loc.robot import RobotDescription
from continuum_loc.scene.anomalies import AnomalySettings, mahalanobis2
from continuum_loc.scene.reconstruct import reconstruct, Reconstruction
from continuum_loc.trajectory import BASE, Trajectory
from msg_tools.records import CloudRecord
import numpy as np


class RecentPoses:
    """The poses of the newest `duration` seconds."""

    def __init__(self, duration: float) -> None:
        self.duration = nanoseconds(duration)
        self._poses: deque[tuple[int, np.ndarray]] = deque()

    def add(self, estimate: Estimate) -> None:
        """Keep an estimate's poses; a repeated instant is replaced."""
        while self._poses and self._poses[-1][0] >= estimate.stamp:
            self._poses.pop()
        self._poses.append((estimate.stamp, estimate.T_map_ring.copy()))
        while self._poses[0][0] < estimate.stamp - self.duration:
            self._poses.popleft()

    def recent(self, count: int) -> list[int]:
        """Return the newest `count` stamps."""
        return [stamp for stamp, _ in list(islice(reversed(self._poses), count))[::-1]]

    def trajectory(self, robot: RobotDescription) -> Trajectory:
        """All that is kept."""
        poses = list(self._poses)  # the worker may add meanwhile
        names = (BASE, *robot.ring_names)
        if not poses:
            return Trajectory.empty(names)
        return Trajectory(
            np.array([stamp for stamp, _ in poses], np.int64),
            names,
            np.stack([T for _, T in poses]),
        )


class SeenScene:
    """
    What the ToF sensors met in the newest `duration` seconds, placed in the map.

    Points with covariance (paper, eqs. 10-11) and their distance to the prior map (eq. 12). A
    frame waits until smoothed poses span its time. `work` then places one instant at a time, so
    that its caller decides when there is leisure for it.
    """

    def __init__(self, robot: RobotDescription, prior: PriorMap | None, duration: float) -> None:
        self.duration = duration
        self.skipped = 0  # frames that no smoothed poses span, or that waited for too long
        self._robot, self._prior = robot, prior
        self._search_radius = AnomalySettings().search_radius
        self._frames: list[TofFrame] = []
        self._jobs: deque[tuple[list[TofFrame], Trajectory]] = deque()
        self._seen: deque[tuple[int, Reconstruction, np.ndarray]] = deque()
        self._last: Estimate | None = None

    def see(self, frame: TofFrame) -> None:
        """Take a frame that later poses will place; nothing is kept where `duration` is 0."""
        if self.duration > 0.0:
            self._frames.append(frame)

    def follow(self, smoothed: Estimate) -> None:
        """Take the next smoothed poses: what was seen up to their time can be placed."""
        last, self._last = self._last, smoothed
        if last is None or smoothed.stamp <= last.stamp:
            last = smoothed
        past = [frame for frame in self._frames if frame.stamp <= smoothed.stamp]
        spanned = [frame for frame in past if frame.stamp >= last.stamp]
        self._frames = [frame for frame in self._frames if frame.stamp > smoothed.stamp]
        if {last.status, smoothed.status} != {'tracking'}:
            spanned = []
        self.skipped += len(past) - len(spanned)
        if spanned:
            poses = [smoothed] if last is smoothed else [last, smoothed]
            self._jobs.append((spanned, Trajectory.from_estimates(poses, self._robot.ring_names)))
        self._forget(smoothed.stamp)

    def work(self) -> bool:
        """Place the oldest instant that can be; False where there is none."""
        if not self._jobs:
            return False
        frames, trajectory = self._jobs.popleft()
        self._seen.append((int(trajectory.stamps[-1]), *self.placed(frames, trajectory)))
        return True

    def placed(
        self, frames: list[TofFrame], trajectory: Trajectory
    ) -> tuple[Reconstruction, np.ndarray]:
        """Place N points; with their Mahalanobis distance (N,) to the map, NaN without a map."""
        points = reconstruct(self._robot, frames, trajectory)
        if self._prior is None:
            return points, np.full(len(points.points), np.nan)
        squared, _ = mahalanobis2(points, self._prior, self._search_radius, self._prior.index)
        return points, np.sqrt(squared)

    def clear(self) -> None:
        """Forget everything."""
        self._last, self._frames = None, []
        self._jobs.clear()
        self._seen.clear()

    @property
    def stamp(self) -> int:
        """Of the newest instant that was placed [ns]; 0 where there is none."""
        return self._seen[-1][0] if self._seen else 0

    def record(self) -> CloudRecord:
        """All points as the `reconstruction` topic carries them."""
        seen = list(self._seen)
        return CloudRecord(
            self.stamp,
            dict(zip('xyz', _joined([part.points for _, part, _ in seen], (0, 3)).T, strict=True))
            | {
                'sigma': _joined([part.sigma for _, part, _ in seen]),
                'anomaly': _joined([anomaly for *_, anomaly in seen]),
            },
        )

    def save(self, path: Path) -> None:
        """Write a `.ply` of all points, new ones (eq. 12) marked; ValueError if there are none."""
        seen = list(self._seen)  # the worker may add meanwhile
        if not any(len(part.points) for _, part, _ in seen):
            raise ValueError('nothing was reconstructed yet')
        whole = Reconstruction.joined([part for _, part, _ in seen])
        new = _joined([anomaly for *_, anomaly in seen]) ** 2 > AnomalySettings().tau
        whole.save(path, None if self._prior is None else new)

    def _forget(self, now: int) -> None:
        oldest = now - nanoseconds(self.duration)
        while self._seen and self._seen[0][0] < oldest:
            self._seen.popleft()
        while self._jobs and self._jobs[0][1].stamps[-1] < oldest:
            self.skipped += len(self._jobs.popleft()[0])


def _joined(parts: list[np.ndarray], empty: tuple[int, ...] = (0,)) -> np.ndarray:
    return np.concatenate([np.empty(empty), *parts])
