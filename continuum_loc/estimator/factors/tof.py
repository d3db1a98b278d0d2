"""
ToF: the zones of a frame against the prior map.

`matching` makes one 6x6 information of the body's pose of all zones of a frame; here it is chained
through the interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from continuum_loc import lie_kernels
from continuum_loc.compiling import kernel
from continuum_loc.corrections import measured_share
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.border import add_local
from continuum_loc.estimator.factors.base import (
    ClockScores,
    Factor,
    FactorReport,
    known_sensor,
    Repeats,
)
from continuum_loc.estimator.matching import (
    Frame,
    frame_of,
    match,
    Rules,
    unmatched,
    weigh,
    weigh_ranges,
)
from continuum_loc.estimator.normal import gather, new_normal, scatter
from continuum_loc.estimator.parameters import Parameters
from continuum_loc.estimator.state import ends_in_time, rows_in_time
from continuum_loc.estimator.tolerance import MOUNT
from continuum_loc.measurements import TOF_HALF_CONFIDENT, TOF_VALID, TofFrame
import numpy as np

MOST_REPEATS = 2  # frames: the noise of 64 zones never repeats
HALF_CONFIDENCE_VARIANCE = 4.0  # status 6 and 9 are right half of the time
GATE_SHRINK = 0.75  # of the gate of association, at each iteration from a guess


@dataclass(slots=True, eq=False)
class Row:
    """One `Frame`; its matches outlive a batch, in whose arrays they come to stand."""

    sensor: int
    node: int
    q: np.ndarray
    rays: np.ndarray
    variance: np.ndarray
    hits: np.ndarray
    places: np.ndarray


class Batch(NamedTuple):
    """M frames, node by node and there sensor by sensor; fields of `frames` have M in front."""

    times: np.ndarray
    sensors: np.ndarray
    nodes: np.ndarray
    frames: Frame


class Sensors(NamedTuple):
    """How much each of S sensors counts, and what becomes of its zones."""

    weights: np.ndarray  # (S,)
    tally: np.ndarray  # (S, 4) usable and fitting zones, and those of `_count_flicker`


class Optics(NamedTuple):
    """What a range is worth: its limits, and noise over distance at some distances."""

    min_range: float
    max_range: float
    distance: np.ndarray
    coefficient: np.ndarray


class Optical(NamedTuple):
    """
    What the constants of S sensors are measured by.

    weights: (S,) what each counts by; columns: (S, 16) places of mount, range, clock, delay and
    map; T_ring_sensor: (S, 4, 4); along: (Z,) one over the share of a zone's range that is
    measured; T_map_middle: (4, 4).
    """

    weights: np.ndarray
    columns: np.ndarray
    T_ring_sensor: np.ndarray
    along: np.ndarray
    T_map_middle: np.ndarray


class Unit(NamedTuple):
    """Where a sensor is in its node's frame (3,), and `Optical.along`."""

    origin: np.ndarray
    along: np.ndarray


class TofFactor(Factor):
    """Zones of a ToF frame against the map's surface."""

    name = 'tof'
    consumes = TofFrame
    batch = Batch
    tolerances = MOUNT

    def __init__(self, setup):
        super().__init__(setup, [sensor.name for sensor in setup.robot.tof])
        self.rate = setup.robot.tof_model.rate
        self.surface = setup.surface
        self._repeats = Repeats(MOST_REPEATS)
        self._optical: tuple[Parameters, Optical] | None = None
        self.describe(setup.robot)
        model, options = self.robot.tof_model, self.settings.tof
        self._optics = Optics(
            model.min_range,
            model.max_range,
            np.array(model.noise_distance),
            np.array(model.noise_coefficient),
        )
        half_zone = np.tan(np.radians(model.fov_deg) / 2.0) / max(model.rows, model.columns)
        self._tracking = Rules(
            options.gate,
            options.min_cosine,
            options.reassociate,
            options.floor**2,
            options.footprint * half_zone,
            options.cauchy,
        )
        self.rules = self._tracking

    @classmethod
    def wanted(cls, setup):
        return super().wanted(setup) and setup.prior_map is not None and bool(setup.robot.tof)

    def describe(self, robot):
        super().describe(robot)
        self._sensors = {
            sensor.name: (
                number,
                self.grid.node_at(self.robot.sensor_arclength(sensor.name)),
                sensor.mount.T_ring_sensor,
            )
            for number, sensor in enumerate(self.robot.tof)
        }

    @property
    def tight(self):
        return self.rules.gate <= self._tracking.gate

    def use_map(self, setup, rows):
        self.surface = setup.surface
        for row in rows:
            row.hits[:], row.places[:] = unmatched(len(row.hits))

    def loosen(self, iteration):
        """
        Open the gate, widest at first, and tighten the loss.

        A wrong body must not pay for few far zones by many near ones. Every zone is matched anew
        at each iteration, as a body that comes from afar may otherwise halt where its next step
        moves none of them far enough.
        """
        options, before = self.settings.tof, self.rules.gate
        self.rules = self._tracking
        if iteration > 0:
            gate = max(options.gate, options.acquisition_gate * GATE_SHRINK**iteration)
            self.rules = self._tracking._replace(
                gate=gate, reassociate=0.0, cauchy=options.acquisition_cauchy
            )
        return self.rules.gate != before

    def row(self, measurement: TofFrame) -> Row:
        number, node, T_ring_sensor = known_sensor(self._sensors, measurement.sensor, 'ToF')
        model = self.robot.tof_model
        points = np.asarray(measurement.points, float)
        if points.shape != (model.rows * model.columns, 3):
            raise MeasurementError(
                'wrong size',
                f"ToF frame of '{measurement.sensor}' has points {points.shape}; "
                f'the robot description says {model.rows} x {model.columns} zones',
            )
        q, rays, variance = np.empty(points.shape), np.empty(points.shape), np.empty(len(points))
        status = np.asarray(measurement.status)
        usable = _read(points, status, T_ring_sensor, self._optics, q, rays, variance)
        if usable > 0 and self._repeats.frozen(measurement.sensor, points):
            raise MeasurementError(
                'frozen', f"ToF sensor '{measurement.sensor}' repeats itself to the last bit"
            )
        return Row(number, node, q, rays, variance, *unmatched(len(points)))

    def stack(self, times, rows):
        sensors = np.array([row.sensor for row in rows])
        order = np.lexsort((times, sensors, [row.node for row in rows]))
        rows = [rows[m] for m in order]
        frames = Frame(*(np.array([getattr(row, part) for row in rows]) for part in Frame._fields))
        for row, hits, places in zip(rows, frames.hits, frames.places, strict=True):
            row.hits, row.places = hits, places
        return Batch(times[order], sensors[order], np.array([row.node for row in rows]), frames)

    def linearise(self, batch, a, b, normal):
        sensors = Sensors(self.weights, np.zeros((len(self.sensors), 4)))
        sums = _add(normal, a, b, batch, sensors, self.surface, self.rules, self._work)
        return FactorReport(*sums, fits=sensors.tally[:, :2], flicker=sensors.tally[:, 2:])

    def bordered(self, batch, a, b, border, of):
        if self._optical is None or self._optical[0] is not of:
            self._optical = of, self._optical_of(of)
        optical = self._optical[1]._replace(weights=self.weights)
        planes, rules = self.surface.planes, self.rules
        _add_border(border, a, b, batch, planes, rules, optical, self._work)

    def _optical_of(self, of):
        kinds = [of.columns(kind, self.sensors) for kind in ('mount', 'range', 'clock', 'delay')]
        columns = np.hstack([*kinds, np.tile(of.columns('map', ['']), (len(self.sensors), 1))])
        T_map_middle = np.eye(4)
        T_map_middle[:3, 3] = of.middle
        mounts = np.array([sensor.mount.T_ring_sensor for sensor in self.robot.tof])
        return Optical(
            self.weights, columns, mounts, 1.0 / measured_share(self.robot.tof_model), T_map_middle
        )

    def clock_scores(self, batch, a, b):
        scores = ClockScores.zeros(len(self.sensors), 1 + len(MOUNT), self.grid.dim)
        planes = self.surface.planes
        _add_clocks(scores, a, b, batch, self.weights, planes, self.rules, self._work)
        return scores._replace(spread=np.ones(len(self.sensors)))  # the loss took care of outliers


@kernel
def _add_border(border, a, b, batch, planes, rules, optical, work):
    """Add what each frame says of mount, range and clock of its sensor, and of the map."""
    local, M = new_normal(8), np.zeros((8, 16))
    back, Ad = np.empty((4, 4)), np.empty((6, 6))
    index, related = np.empty(24, np.int64), -1
    M[6, 6] = M[7, 7] = 1.0
    for f in range(batch.times.shape[0]):
        n, s, frame = batch.nodes[f], batch.sensors[f], frame_of(batch.frames, f)
        if n != related:  # frames of a node come after one another
            gp.relate(ends_in_time(a, b, n), work)
            rows_in_time(n, border.C.shape[0] // 2, index)
            related = n
        gp.evaluate(work, batch.times[f], True, 6)
        at = work[0]
        unit = Unit(optical.T_ring_sensor[s, :3, 3], optical.along)
        weigh_ranges(at.T, frame, optical.weights[s], planes, rules, unit, local)
        lie_kernels.adjoint(optical.T_ring_sensor[s], Ad)
        M[:6, :6] = Ad
        M[:6, 8] = M[:6, 9] = at.v
        lie_kernels.relative(at.T, optical.T_map_middle, back)
        lie_kernels.adjoint(back, Ad)
        for i in range(6):
            for j in range(6):
                M[i, 10 + j] = -Ad[i, j]
        add_local(border, index, at.J_pose, optical.columns[s], M, local)


@kernel
def _read(points, status, T_ring_sensor, optics, q, rays, variance):
    """Write the zones in the ring's frame; the number of usable ones."""
    usable = 0
    for z in range(points.shape[0]):
        x, y, w = points[z, 0], points[z, 1], points[z, 2]
        distance = np.sqrt(x * x + y * y + w * w)
        half = status[z] == TOF_HALF_CONFIDENT[0] or status[z] == TOF_HALF_CONFIDENT[1]
        trusted = status[z] == TOF_VALID or half
        valid = trusted and optics.min_range <= distance <= optics.max_range
        for i in range(3):
            turned = T_ring_sensor[i, 0] * x + T_ring_sensor[i, 1] * y + T_ring_sensor[i, 2] * w
            q[z, i] = (turned if valid else 0.0) + T_ring_sensor[i, 3]
            rays[z, i] = turned / distance if valid else 0.0
        if not valid:
            variance[z] = np.inf
            continue
        usable += 1
        sigma = np.interp(distance, optics.distance, optics.coefficient) * distance
        variance[z] = sigma * sigma * (HALF_CONFIDENCE_VARIANCE if half else 1.0)
    return usable


@kernel
def _add(normal, a, b, batch, sensors, surface, rules, work):
    """Add the frames; returns robust cost, sum of weighted squared residuals and their number."""
    total, local, index = new_normal(24), new_normal(6), np.empty(24, np.int64)
    product, frames, planes = np.empty((6, 24)), batch.times.shape[0], surface.planes
    cost, squared, count, related = 0.0, 0.0, 0, -1
    for f in range(frames):
        n, s, frame = batch.nodes[f], batch.sensors[f], frame_of(batch.frames, f)
        if n != related:  # frames of a node come after one another
            gp.relate(ends_in_time(a, b, n), work)
            related = n
        gp.evaluate(work, batch.times[f], True, 6)
        at, tally = work[0], sensors.tally[s]
        match(at.T, frame, surface.lookup, rules)
        sums = weigh(at.T, frame, sensors.weights[s], planes, rules, local, tally)
        gather(total, local, at.J_pose, product)
        if f + 1 == frames or batch.nodes[f + 1] != n:
            rows_in_time(n, normal.g.shape[0] // 2, index)
            scatter(normal, index, total, 1.0)
        if f > 0 and batch.sensors[f - 1] == s:
            _count_flicker(frame_of(batch.frames, f - 1), frame, tally)
        cost += sums[0]
        squared += sums[1]
        count += sums[2]
    return cost, squared, count


@kernel
def _count_flicker(before, frame, tally):
    """Count zones seen in two frames in a row, and those of them that were matched in just one."""
    for z in range(frame.hits.shape[0]):
        if np.isfinite(before.variance[z]) and np.isfinite(frame.variance[z]):
            tally[2] += 1.0
            if (before.hits[z] < 0) != (frame.hits[z] < 0):
                tally[3] += 1.0


@kernel
def _add_clocks(scores, a, b, batch, weights, planes, rules, work):
    """
    Add what each frame says of its sensor's clock and mount.

    The frame moves by X = [v, 1]: the body's velocity then, or any twist of the mount; what its
    local equations (H, g) say of these is X^T g, X^T H X and J^T H X.
    """
    local, X, HX, tally = new_normal(6), np.zeros((6, 7)), np.empty((6, 7)), np.empty(4)
    index, related = np.empty(24, np.int64), -1
    for i in range(6):
        X[i, 1 + i] = 1.0
    for f in range(batch.times.shape[0]):
        n, s, frame = batch.nodes[f], batch.sensors[f], frame_of(batch.frames, f)
        if n != related:  # frames of a node come after one another
            gp.relate(ends_in_time(a, b, n), work)
            rows_in_time(n, scores.coupling.shape[0] // 2, index)
            related = n
        gp.evaluate(work, batch.times[f], True, 6)
        at = work[0]
        weigh(at.T, frame, weights[s], planes, rules, local, tally)
        X[:, 0] = at.v
        HX[:, :] = local.H @ X
        scores.gradient[s] += X.T @ local.g
        scores.information[s] += X.T @ HX
        J = at.J_pose.T @ HX
        for j in range(24):
            scores.coupling[index[j], s] += J[j]
