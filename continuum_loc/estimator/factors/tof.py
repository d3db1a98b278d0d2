"""
ToF: point-to-plane against the prior map (paper eqs. 1-4).

A zone is associated anew once it has moved.

All zones of one frame share (s, t), so their residuals gather in one 6x6 information block in the
body frame, which is chained once through the interpolation. With b = R^T n the row of a zone is
[b, q x b] for a right perturbation.
The noise acts along the beam: a hit at incidence n . d counts with variance sigma_d^2 (n . d)^2
plus the floor.
"""

from __future__ import annotations

from continuum_loc import lie_kernels
from continuum_loc.errors import MeasurementError
from continuum_loc.estimator import gp
from continuum_loc.estimator.factors.base import (
    ClockScores,
    Factor,
    FactorReport,
    known_sensor,
    Repeats,
)
from continuum_loc.estimator.state import VELOCITY
from continuum_loc.mapping.lookup import nearest_facing_batch
from continuum_loc.measurements import TOF_HALF_CONFIDENT, TOF_VALID, TofFrame
from numba import njit
import numpy as np

MOST_REPEATS = 2  # frames: the noise of 64 zones never repeats
FIT_SIGMAS = 3.0  # a zone within so many sigmas of its surface counts as fitting
HALF_CONFIDENCE_VARIANCE = 4.0  # status 6 and 9 are right half of the time


class TofFactor(Factor):
    """
    Zones of a ToF frame against the map's surface.

    `index` is the map's lookup, None switches the factor off.
    """

    name = 'tof'
    consumes = TofFrame

    def __init__(self, robot, grid, settings, prior_map=None, index=None):
        super().__init__(robot, grid, settings)
        self.gate, self.cauchy = settings.tof.gate, settings.tof.cauchy
        self.reassociate = settings.tof.reassociate
        self.weights = dict.fromkeys((sensor.name for sensor in robot.tof), 1.0)
        self._sensors = {
            sensor.name: (
                number,
                grid.node_at(robot.sensor_arclength(sensor.name)),
                sensor.mount.T_ring_sensor,
            )
            for number, sensor in enumerate(robot.tof)
        }
        self._names = list(self._sensors)
        self.index = index
        self._repeats = Repeats(MOST_REPEATS)
        if prior_map is not None:
            # A flat patch of scattered points has 0.8 to 0.9, which counts as whole: as a share of
            # the information it would make the covariance too large.
            flat = max(float(np.median(prior_map.planarity)), 1e-9)
            alpha = np.minimum(prior_map.planarity / flat, 1.0)
            weight = alpha**settings.tof.planarity_power
            self.surface = np.column_stack([prior_map.points, prior_map.normals, weight])
            self._map_variance = prior_map.sigma**2
        model = robot.tof_model
        self._noise_distance = np.array(model.noise_distance)
        self._noise_coefficient = np.array(model.noise_coefficient)
        self._half_zone = np.tan(np.radians(model.fov_deg) / 2.0) / max(model.rows, model.columns)

    @property
    def map_arrays(self) -> tuple:
        """Lookup, surface (P, 7) of points, normals and weights, and its variance."""
        return self.index.arrays, self.surface, self._map_variance

    def row(self, measurement: TofFrame) -> tuple:
        number, node, T_ring_sensor = known_sensor(self._sensors, measurement.sensor, 'ToF')
        if self.index is None:
            raise MeasurementError('no map', 'ToF frames need a prior map')
        model = self.robot.tof_model
        points = np.asarray(measurement.points, float)
        if points.shape != (model.rows * model.columns, 3):
            raise MeasurementError(
                'wrong size',
                f"ToF frame of '{measurement.sensor}' has points {points.shape}; "
                f'the robot description says {model.rows} x {model.columns} zones',
            )
        q, rays = np.empty(points.shape), np.empty(points.shape)
        variance = np.empty(len(points))
        usable = _beams(
            points,
            np.asarray(measurement.status),
            T_ring_sensor,
            model.min_range,
            model.max_range,
            self._noise_distance,
            self._noise_coefficient,
            q,
            rays,
            variance,
        )
        if usable > 0 and self._repeats.frozen(measurement.sensor, points):
            raise MeasurementError(
                'frozen', f"ToF sensor '{measurement.sensor}' repeats itself to the last bit"
            )
        return number, node, q, rays, variance, Matches(len(points))

    def stack(self, times, rows):
        """
        Stack the rows of one interval.

        The matches of each row become a view into the stacked arrays, so that they outlive the
        next stacking.
        """
        sensors = np.array([row[0] for row in rows])
        order = np.lexsort((times, sensors, [row[1] for row in rows]))  # node by node
        times, sensors, rows = times[order], sensors[order], [rows[m] for m in order]
        kept = [row[5] for row in rows]
        hits, places = np.array([one.hits for one in kept]), np.array([one.places for one in kept])
        for one, hit, place in zip(kept, hits, places, strict=True):
            one.hits, one.places = hit, place
        first = np.flatnonzero(sensors[:-1] == sensors[1:])
        pairs = np.stack([first, first + 1])  # of frames in a row of the same sensor
        arrays = (np.array([row[i] for row in rows]) for i in range(1, 5))
        return times, sensors, *arrays, hits, places, pairs

    def linearise(self, batch, a, b, blocks):
        times, sensors, nodes, q, rays, variance, hits, places, _ = batch
        options = self.settings.tof
        weights = np.array([self.weights[self._names[s]] for s in sensors])
        fits = np.zeros((len(times), 2))
        cost, squared, count = _add(
            blocks.H,
            blocks.g,
            a.T,
            a.velocity,
            b.T,
            b.velocity,
            b.time - a.time,
            times,
            nodes,
            q,
            rays,
            variance,
            weights,
            *self.map_arrays,
            options.floor**2,
            options.footprint * self._half_zone,
            self.cauchy,
            self.gate,
            options.min_cosine,
            self.reassociate,
            hits,
            places,
            fits,
        )
        by_sensor = np.zeros((len(self._names), 2))
        np.add.at(by_sensor, sensors, fits)
        heard = np.flatnonzero(np.bincount(sensors, minlength=len(self._names)))
        fits = {self._names[s]: by_sensor[s] for s in heard}
        return FactorReport(cost, squared, count, fits, flicker=self._flicker(batch))

    def clock_scores(self, batch, a, b):
        times, sensors, nodes, q, rays, variance, hits, _, _ = batch
        options = self.settings.tof
        weights = np.array([self.weights[self._names[s]] for s in sensors])
        gradient, information = np.zeros((2, len(self._names)))
        coupling = np.zeros((2 * self.grid.dim, len(self._names)))
        _add_clocks(
            gradient,
            information,
            coupling,
            sensors,
            a.T,
            a.velocity,
            b.T,
            b.velocity,
            b.time - a.time,
            times,
            nodes,
            q,
            rays,
            variance,
            weights,
            *self.map_arrays[1:],
            options.floor**2,
            options.footprint * self._half_zone,
            self.cauchy,
            self.gate,
            hits,
        )
        usual = np.ones(len(self._names))  # outliers the loss has taken care of
        return ClockScores(self._names, gradient, information, coupling, usual)

    def _flicker(self, batch: tuple) -> dict[str, np.ndarray]:
        """Count by sensor zones seen in two frames in a row, and those matched in just one."""
        sensors, variance, hits, pairs = batch[1], batch[5], batch[6], batch[8]
        usable, matched = np.isfinite(variance), hits >= 0
        both = usable[pairs[0]] & usable[pairs[1]]
        changed = both & (matched[pairs[0]] != matched[pairs[1]])
        counts = np.zeros((len(self._names), 2))
        np.add.at(counts, sensors[pairs[1]], np.stack([both.sum(1), changed.sum(1)], 1))
        return {self._names[s]: counts[s] for s in np.flatnonzero(counts[:, 0])}


class Matches:
    """
    What a frame's zones were matched to.

    hits: (Z,) rows of the map, -1 where there is none; places: (Z, 4) where the zone was then [m],
    and the gate, as another gate matches anew.
    """

    __slots__ = ('hits', 'places')

    def __init__(self, zones: int):
        self.hits = np.full(zones, -1, np.int64)
        self.places = np.full((zones, 4), np.nan)


@njit(cache=True)
def _beams(
    points,
    status,
    T_ring_sensor,
    min_range,
    max_range,
    noise_distance,
    noise_coefficient,
    q,
    rays,
    variance,
):
    """
    Zones in the ring's frame, and the number of usable ones.

    q, rays (Z, 3), variance (Z,), infinite where unusable.
    """
    usable = 0
    for z in range(points.shape[0]):
        x, y, w = points[z, 0], points[z, 1], points[z, 2]
        distance = np.sqrt(x * x + y * y + w * w)
        half = status[z] == TOF_HALF_CONFIDENT[0] or status[z] == TOF_HALF_CONFIDENT[1]
        valid = (status[z] == TOF_VALID or half) and min_range <= distance <= max_range
        for i in range(3):
            turned = T_ring_sensor[i, 0] * x + T_ring_sensor[i, 1] * y + T_ring_sensor[i, 2] * w
            q[z, i] = (turned if valid else 0.0) + T_ring_sensor[i, 3]
            rays[z, i] = turned / distance if valid else 0.0
        if not valid:
            variance[z] = np.inf
            continue
        usable += 1
        sigma = np.interp(distance, noise_distance, noise_coefficient) * distance
        variance[z] = sigma * sigma * (HALF_CONFIDENCE_VARIANCE if half else 1.0)
    return usable


@njit(cache=True)
def _add(
    H,
    g,
    T_a,
    v_a,
    T_b,
    v_b,
    dt,
    times,
    nodes,
    q,
    rays,
    variance,
    weights,
    arrays,
    surface,
    map_variance,
    floor2,
    footprint,
    cauchy,
    gate,
    min_cosine,
    reassociate,
    hits,
    places,
    fits,
):
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((6, 24)), np.empty((0, 24))
    index, work = np.empty(24, np.int64), np.empty((6, 24))
    H_body, g_body, H_node, g_node = (
        np.empty((6, 6)),
        np.empty(6),
        np.zeros((24, 24)),
        np.zeros(24),
    )
    size = H.shape[0] // 2
    cost, squared, count, related = 0.0, 0.0, 0, -1
    for f in range(times.shape[0]):
        n = nodes[f]
        if n != related:  # frames of a node come after one another
            gp.relate(T_a[n], T_b[n], v_b[n], W, V, M)
            related = n
        gp.evaluate(T_a[n], v_a[n], dt, times[f], T, v, J_pose, J_rate, W, V, M, J_work)
        associate(
            T,
            q[f],
            rays[f],
            variance[f],
            arrays,
            gate,
            min_cosine,
            reassociate,
            hits[f],
            places[f],
        )
        frame_cost, frame_squared, frame_count = frame_information(
            T,
            q[f],
            rays[f],
            variance[f],
            hits[f],
            weights[f],
            surface,
            map_variance,
            floor2,
            footprint,
            cauchy,
            gate,
            H_body,
            g_body,
            fits[f],
        )
        gp.gather(H_node, g_node, H_body, g_body, J_pose, work)
        if f + 1 == times.shape[0] or nodes[f + 1] != n:
            gp.time_index(n, VELOCITY, size, index)
            gp.scatter(H, g, index, H_node, g_node, 1.0)
        cost += frame_cost
        squared += frame_squared
        count += frame_count
    return cost, squared, count


@njit(cache=True)
def _add_clocks(
    gradient,
    information,
    coupling,
    sensors,
    T_a,
    v_a,
    T_b,
    v_b,
    dt,
    times,
    nodes,
    q,
    rays,
    variance,
    weights,
    surface,
    map_variance,
    floor2,
    footprint,
    cauchy,
    gate,
    hits,
):
    """Add each frame's v^T g, v^T H v and J^T H v to its sensor's, v the body's velocity then."""
    W, V, M = lie_kernels.workspace()
    J_work = np.empty((2, 6, 24))
    T, v, J_pose, J_rate = np.empty((4, 4)), np.empty(6), np.empty((6, 24)), np.empty((0, 24))
    index, fit = np.empty(24, np.int64), np.empty(2)
    H, g, Hv = np.empty((6, 6)), np.empty(6), np.empty(6)
    related = -1
    for f in range(times.shape[0]):
        n, s = nodes[f], sensors[f]
        if n != related:  # frames of a node come after one another
            gp.relate(T_a[n], T_b[n], v_b[n], W, V, M)
            related = n
        gp.evaluate(T_a[n], v_a[n], dt, times[f], T, v, J_pose, J_rate, W, V, M, J_work)
        frame_information(
            T,
            q[f],
            rays[f],
            variance[f],
            hits[f],
            weights[f],
            surface,
            map_variance,
            floor2,
            footprint,
            cauchy,
            gate,
            H,
            g,
            fit,
        )
        lie_kernels.apply(H, v, Hv)
        gp.time_index(n, VELOCITY, coupling.shape[0] // 2, index)
        for i in range(6):
            gradient[s] += g[i] * v[i]
            information[s] += Hv[i] * v[i]
            for j in range(24):
                coupling[index[j], s] += J_pose[i, j] * Hv[i]


@njit(cache=True)
def associate(T, q, rays, variance, arrays, gate, min_cosine, reassociate, hits, places):
    """
    Match each zone to the nearest map point that faces its beam, at T_map_body.

    Hits (Z,) and places (Z, 4) are those of `Matches`: a zone that moved by no more than
    `reassociate` [m] since it was matched with this gate keeps its hit.
    """
    zones, asked = q.shape[0], 0
    points, directions = np.empty((zones, 3)), np.empty((zones, 3))
    rows, found, distance2 = np.empty(zones, np.int64), np.empty(zones, np.int64), np.empty(zones)
    for z in range(zones):
        if not np.isfinite(variance[z]):
            continue
        moved2 = 0.0
        for i in range(3):
            points[asked, i] = T[i, 0] * q[z, 0] + T[i, 1] * q[z, 1] + T[i, 2] * q[z, 2] + T[i, 3]
            moved2 += (points[asked, i] - places[z, i]) ** 2
        if places[z, 3] == gate and moved2 <= reassociate * reassociate:
            continue
        for i in range(3):
            places[z, i] = points[asked, i]
            directions[asked, i] = (
                T[i, 0] * rays[z, 0] + T[i, 1] * rays[z, 1] + T[i, 2] * rays[z, 2]
            )
        places[z, 3] = gate
        rows[asked] = z
        asked += 1
    nearest_facing_batch(
        arrays, points[:asked], directions[:asked], gate, min_cosine, found, distance2
    )
    for k in range(asked):
        hits[rows[k]] = found[k]


@njit(cache=True)
def frame_information(
    T,
    q,
    rays,
    variance,
    hits,
    weight,
    surface,
    map_variance,
    floor2,
    footprint,
    cauchy,
    gate,
    H,
    g,
    fit,
):
    """
    Add up one frame's H (6, 6), g (6,) at T_map_body; [usable, fitting] zones go to `fit`.

    Returns the robust cost, the sum of weighted squared residuals and the number of matched zones.
    An unmatched zone costs what a residual at the gate would, so that losing matches never pays.
    """
    H[:, :] = 0.0
    g[:] = 0.0
    cost, squared, count = 0.0, 0.0, 0
    row = np.empty(6)
    c2 = cauchy * cauchy
    fit[0] = 0.0
    fit[1] = 0.0
    for z in range(q.shape[0]):
        if not np.isfinite(variance[z]):
            continue
        fit[0] += 1.0
        hit = hits[z]
        if hit < 0:
            cost += 0.5 * weight * c2 * np.log1p(gate * gate / (c2 * (variance[z] + floor2)))
            continue
        a, b, c = q[z, 0], q[z, 1], q[z, 2]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        w = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        nx, ny, nz = surface[hit, 3], surface[hit, 4], surface[hit, 5]
        r = nx * (x - surface[hit, 0]) + ny * (y - surface[hit, 1]) + nz * (w - surface[hit, 2])
        row[0] = T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz
        row[1] = T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz
        row[2] = T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz
        cosine = row[0] * rays[z, 0] + row[1] * rays[z, 1] + row[2] * rays[z, 2]
        cosine2 = cosine * cosine
        spread = footprint * np.sqrt(a * a + b * b + c * c)
        total = variance[z] * cosine2 + spread * spread * (1.0 - cosine2) + floor2 + map_variance
        u2 = r * r / total
        robust = 1.0 / (1.0 + u2 / c2)
        alpha = weight * surface[hit, 6]
        information = alpha * robust / total
        row[3] = b * row[2] - c * row[1]
        row[4] = c * row[0] - a * row[2]
        row[5] = a * row[1] - b * row[0]
        for i in range(6):
            scaled = information * row[i]
            g[i] += scaled * r
            for j in range(i + 1):
                H[i, j] += scaled * row[j]
        cost += 0.5 * alpha * c2 * np.log1p(u2 / c2)
        squared += u2 * robust
        count += 1
        if u2 < FIT_SIGMAS * FIT_SIGMAS:
            fit[1] += 1.0
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return cost, squared, count
