"""
Whether a ToF sensor sees what it should: as described, with its zones otherwise, or neither.

Its newest frames are laid upon the map from a body in whose estimate it has no say. No sensor sits
quite where it is described, so that all frames together may move by one small twist, under a prior
of what people build and of what is not known of the body; only what is left of the residuals then
speaks against the description. The same is done with the rows or columns of zones the other way
round, and with the other convention of ranges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from continuum_loc import lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.estimator.apart import Apart, settled
from continuum_loc.estimator.factors import TofFactor
from continuum_loc.estimator.interpolation import interpolated
from continuum_loc.estimator.matching import Frame, frame_of, match, unmatched, weigh
from continuum_loc.estimator.normal import new_normal
from continuum_loc.estimator.state import POSE_PART
from continuum_loc.estimator.tolerance import MOUNT
from continuum_loc.estimator.window import Window
from continuum_loc.robot import RobotDescription, TofModel
import numpy as np

TOO_FAR = 33.1  # chi-squared of six degrees of freedom at 1e-5: no mount is that far off
FRAMES = 4  # newest of a sensor
ITERATIONS = 5
FITS = 0.7  # share of zones that fit where all is as described
CLEARLY = 0.85  # share that has to fit with the zones otherwise
TIMES = 3.0  # by which the cost has to be less then


class Sight(NamedTuple):
    """What a sensor's frames come to: share of zones that fit, and the cause if one is clear."""

    share: float
    cause: str

    @property
    def wrong(self) -> bool:
        """Whether the sensor does not see what it should."""
        return self.share < FITS or bool(self.cause)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One way to read a frame: each zone's place in it, and the factor of its range."""

    cause: str
    zone: np.ndarray
    scale: np.ndarray


def readings_of(model: TofModel) -> list[Reading]:
    """List the ways, that of the description first."""
    zones = np.arange(model.rows * model.columns).reshape(model.rows, model.columns)
    same, cosine, ones = zones.ravel(), model.directions[:, 0], np.ones(zones.size)
    found = [
        Reading('', same, ones),
        Reading('perpendicular distances taken for ranges?', same, 1.0 / cosine),
        Reading('ranges taken for perpendicular distances?', same, cosine),
        Reading('rows of zones the other way round?', zones[::-1].ravel(), ones),
        Reading('columns of zones the other way round?', zones[:, ::-1].ravel(), ones),
        Reading('rows and columns of zones the other way round?', zones[::-1, ::-1].ravel(), ones),
    ]
    if model.rows == model.columns:
        found.append(Reading('rows of zones taken for columns?', zones.T.ravel(), ones))
    return found


class Sighting:
    """Judges one ToF sensor at a time."""

    def __init__(self, robot: RobotDescription, window: Window, tof: TofFactor):
        self._window, self._tof = window, tof
        self._readings = readings_of(robot.tof_model)
        directions = robot.tof_model.directions
        mounts = {sensor.name: sensor.mount.T_ring_sensor for sensor in robot.tof}
        self._origins = {name: T[:3, 3] for name, T in mounts.items()}
        self._rays = {name: directions @ T[:3, :3].T for name, T in mounts.items()}

    def judge(self, sensor: str) -> Sight | None:
        """Lay a sensor's newest frames upon the map; None where there are none."""
        number = self._tof.sensors.index(sensor)
        last = settled(self._window) - 1
        body = Apart.of(self._window, self._tof, sensor) if last >= 0 else None
        if body is None:
            return None
        found, k = [], last
        while k >= 0 and len(found) < FRAMES:
            found += self._frames(body, number, k)[::-1]
            k -= 1
        if not found:
            return None
        found = found[:FRAMES]
        node = found[0][2]
        spread = np.diag(MOUNT**2) + body.covariance(last, node, POSE_PART)
        poses = np.array([pose for pose, _, _ in found])
        outcomes = [
            self._laid(sensor, poses, [frame for _, frame, _ in found], one, spread)
            for one in self._readings
        ]
        return self._verdict(outcomes)

    def _frames(self, body: Apart, number: int, k: int) -> list[tuple[np.ndarray, Frame, int]]:
        """Poses, frames and node of a sensor in interval k, in order."""
        batch = self._window.intervals[k].batch(self._tof)
        if batch is None:
            return []
        mine = np.flatnonzero(batch.sensors == number)
        a, b = body.columns[k], body.columns[k + 1]
        poses = interpolated(a, b, batch.times[mine], batch.nodes[mine]).T
        frames = [Frame(*(part[m] for part in batch.frames)) for m in mine]
        return list(zip(poses, frames, batch.nodes[mine], strict=True))

    def _laid(self, sensor, poses, frames, reading, spread) -> tuple[float, float]:
        """Cost of frames that are read in one way, and the share of zones that fit near by."""
        origin, rays = self._origins[sensor], self._rays[sensor]
        read = [_read_as(frame, reading, origin, rays) for frame in frames]
        stacked = Frame(*(np.array(part) for part in zip(*read, strict=True)))
        tally = np.zeros(4)
        rules = self._tof.rules._replace(reassociate=0.0)
        surface, information = self._tof.surface, np.linalg.inv(spread)
        cost, moved = _lay(poses, stacked, information, surface, rules, ITERATIONS, tally)
        share = float(tally[1] / max(tally[0], 1.0))
        return cost, share if moved < TOO_FAR else 0.0

    def _verdict(self, outcomes: list[tuple[float, float]]) -> Sight:
        cost, share = outcomes[0]
        best = min(range(1, len(outcomes)), key=lambda k: outcomes[k][0])
        clear = outcomes[best][1] >= CLEARLY and TIMES * outcomes[best][0] < cost
        return Sight(share, self._readings[best].cause if clear else '')


def _read_as(frame: Frame, reading: Reading, origin: np.ndarray, rays: np.ndarray) -> Frame:
    """Read a frame in another way: its zones' ranges along other beams."""
    if not reading.cause:
        return Frame(*frame[:3], *unmatched(len(frame.q)))  # where its points truly are
    variance = frame.variance[reading.zone]
    ranges = np.linalg.norm(frame.q - origin, axis=1)[reading.zone] * reading.scale
    q = origin + np.where(np.isfinite(variance), ranges, 0.0)[:, None] * rays
    return Frame(q, rays, variance, *unmatched(len(q)))


@kernel
def _lay(poses, frames, information, surface, rules, iterations, tally):
    """
    Move all frames by one twist to the least cost, under its prior's information (6, 6).

    poses: (F, 4, 4) of the node at each frame. Returns the cost and the squared twist over its
    prior's variance; `tally` gets usable and fitting zones.
    """
    total, local = new_normal(6), new_normal(6)
    xi, step, T = np.zeros(6), np.empty((4, 4)), np.empty((4, 4))
    cost, prior = 0.0, np.zeros(6)
    for iteration in range(iterations + 1):
        lie_kernels.exp(xi, step)
        prior = information @ xi
        total.H[:, :] = information
        total.g[:] = prior
        tally[:] = 0.0
        cost = 0.5 * (xi @ prior)
        for f in range(poses.shape[0]):
            lie_kernels.compose(poses[f], step, T)
            frame = frame_of(frames, f)
            match(T, frame, surface.lookup, rules)
            cost += weigh(T, frame, 1.0, surface.planes, rules, local, tally)[0]
            total.H[:, :] += local.H
            total.g[:] += local.g
        if iteration < iterations:
            xi -= np.linalg.solve(total.H, total.g)
    return cost, xi @ prior
