"""The sliding-window filter: start reading here.

A measurement enters by `process`. Its stamp puts it into the interval between two knots; when a cycle of ToF frames
is complete (or `output_rate` says so) the window is solved and an `Estimate` comes out. The window is a chain of
columns (the body at knot times) coupled by intervals (priors and measurements between two knots); the oldest column
is marginalised as the window moves on.
"""

from __future__ import annotations

import time as clock
from collections import Counter
from dataclasses import replace

import numpy as np
from threadpoolctl import ThreadpoolController

from continuum_loc import lie
from continuum_loc.estimator.chain import Chain, Message, SingularError
from continuum_loc.estimator.estimate import Estimate
from continuum_loc.estimator.factors import FACTORS, Factor, MeasurementError, TofFactor
from continuum_loc.estimator.interval import Interval
from continuum_loc.estimator.output import MOTION, Body, backbone, body_between, motion_covariance
from continuum_loc.estimator.priors import Priors
from continuum_loc.estimator.recovery import ShapeSearch, Snapshot, Watch, place
from continuum_loc.estimator.settings import EstimatorSettings
from continuum_loc.estimator.state import NODE_DIM, Column, Grid, column_at_rest
from continuum_loc.measurements import ImuSample, Measurement, TofFrame, seconds
from continuum_loc.robot import RobotDescription

TIME_EPSILON = 1e-9  # stamps are integer nanoseconds
HEALTHY_SHARE = 0.85  # of the median sensor's samples fit, else the body is in doubt and no single sensor
PATIENCE = 1.5  # ToF periods that a cycle waits for silent sensors
DAMPING_LIMIT = 1e4
REST_TURN = 0.005  # [rad] a body that turned farther during the initial rest was not at rest
REST_SIGMA = 0.002  # [rad/s] how well rest is rest
AMBIGUOUS = 0.03  # [m] bodies closer than this at every ring are the same one
COST_SLACK = 1e-3  # relative: associations change between iterations, so costs compare only so well


class SlidingWindowFilter:
    """Pose, strain and velocity of the whole body, online.

    robot: the description; prior_map: a `PriorMap`, or None for a robot without ToF sensors.
    counts: {"received" | "used" | "dropped" | "restarts": Counter}, the latter two by reason.
    """

    def __init__(self, robot: RobotDescription, prior_map=None, settings: EstimatorSettings | None = None):
        self.robot = robot
        self.settings = settings or EstimatorSettings()
        self.grid = Grid(robot, self.settings.node_spacing)
        self.priors = Priors(robot, self.grid, self.settings)
        self.tof = self._make_tof(prior_map)
        self.factors: list[Factor] = [kind(robot, self.grid, self.settings) for kind in FACTORS
                                      if self._wanted(kind.name)]
        if self.tof is not None:
            self.factors.append(self.tof)
            self._shapes = ShapeSearch(self.grid, self.tof, self.settings.recovery, self.priors.rest,
                                       np.array(self.settings.prior.strain))
        self._backbone_s = np.linspace(0.0, robot.length, self.settings.backbone_points)
        self.counts = {"received": Counter(), "used": Counter(), "dropped": Counter(), "restarts": Counter()}
        self._threads = ThreadpoolController()
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counts; the next measurement starts anew."""
        self.epoch: int | None = None
        self.newest: int = 0
        self.columns: list[Column] = []
        self.offsets: list[np.ndarray] = []
        self.intervals: list[Interval] = []
        self.chain: Chain | None = None
        self.acquired = False
        self._marginalised = False
        self._cycle: set[str] = set()
        self._last_cycle: set[str] = set()
        self._cycle_start: int | None = None
        self._rest: dict[str, list[np.ndarray]] | None = {}
        self._rest_bias: tuple[np.ndarray, np.ndarray] | None = None
        self.watch = Watch(self.settings.recovery)
        self.suspects: tuple[str, ...] = ()

    # ------------------------------------------------------------------ measurements in, estimates out

    def process(self, measurement: Measurement) -> Estimate | None:
        """Take one measurement; an Estimate when a step fell due. Measurements that cannot be used are counted."""
        self.counts["received"][type(measurement).__name__] += 1
        estimate = self._step() if self._cycle_over(measurement) else None
        if self._admit(measurement) and self._cycle_complete(measurement):
            estimate = self._step()
        return estimate

    def flush(self) -> Estimate | None:
        """Solve what is pending at the end of the data."""
        return self._step() if self._cycle_start is not None else None

    def _wanted(self, name: str) -> bool:
        return name == "insertion" or getattr(self.settings, name).enabled

    def _make_tof(self, prior_map) -> TofFactor | None:
        if prior_map is None or not self.settings.tof.enabled or not self.robot.tof:
            return None
        from continuum_loc.mapping.voxel_index import VoxelIndex

        index = VoxelIndex(prior_map.points, prior_map.normals)
        return TofFactor(self.robot, self.grid, self.settings, prior_map, index)

    def _admit(self, measurement: Measurement) -> bool:
        """Put the measurement into its interval; False where it was dropped and counted."""
        if self.epoch is None:
            self._start(measurement.stamp)
        time = seconds(measurement.stamp, self.epoch)
        if time < self.columns[0].time - TIME_EPSILON:
            return self._drop("older than the window")
        used = False
        for factor in self.factors:
            if isinstance(measurement, factor.consumes):
                try:
                    row = factor.row(measurement)
                except MeasurementError as error:
                    self._drop(f"{factor.name}: {error.reason}")
                    continue
                self._interval_at(time).add(factor, time, row)
                used = True
        if used:
            self.counts["used"][type(measurement).__name__] += 1
            self.newest = max(self.newest, measurement.stamp)
            self._note_rest(measurement)
        return used

    def _drop(self, reason: str) -> bool:
        self.counts["dropped"][reason] += 1
        return False

    def _cycle_over(self, measurement: Measurement) -> bool:
        """Whether a cycle that began can wait no longer for the sensors that are missing in it."""
        if self._cycle_start is None or measurement.stamp <= self._cycle_start:
            return False
        period = 1.0 / self.settings.output_rate if self.tof is None else PATIENCE / self.robot.tof_model.rate
        again = isinstance(measurement, TofFrame) and measurement.sensor in self._cycle
        return again or seconds(measurement.stamp, self._cycle_start) >= period - TIME_EPSILON

    def _cycle_complete(self, measurement: Measurement) -> bool:
        """Note the measurement in the running cycle; True when every ToF sensor of the last cycle has spoken."""
        self._cycle_start = self._cycle_start or measurement.stamp
        if self.tof is None or not isinstance(measurement, TofFrame):
            return False
        self._cycle.add(measurement.sensor)
        return bool(self._last_cycle) and self._cycle >= self._last_cycle or len(self._cycle) == len(self.robot.tof)

    # ------------------------------------------------------------------ the window

    def _start(self, stamp: int) -> None:
        self.epoch = self.newest = stamp
        strain = np.tile(self.priors.rest, (self.grid.nodes, 1))
        self.columns = [column_at_rest(self.grid, self.priors.T_map_base, strain, 0.0)]
        self.offsets = [np.zeros(self.grid.dim)]
        self._restart_chain(moving=False)

    def _restart_chain(self, moving: bool) -> None:
        """Forget the past of the oldest column."""
        self._moving, self._marginalised = moving, False
        self.chain = Chain(self.grid.dim, self._start_message())
        for interval in self.intervals:
            interval.changed = True

    def _start_message(self) -> Message:
        message = self.priors.start(self.columns[0], self._moving)
        if self._rest_bias is not None:
            weight, mean = self._rest_bias
            at = np.arange(self.grid.bias_offset, self.grid.dim)
            message.information[at, at] += weight
            message.gradient[at] += weight * (self.columns[0].bias.ravel() - mean)
        return message

    def _interval_at(self, time: float) -> Interval:
        """The interval (t_k, t_k+1] that holds `time`, with new knots appended as needed."""
        while time > self.columns[-1].time + TIME_EPSILON or not self.intervals:
            self._append_column()
        k = int(np.ceil((time - self.columns[0].time) / self.settings.knot_period - 1e-6)) - 1
        return self.intervals[min(max(k, 0), len(self.intervals) - 1)]

    def _append_column(self) -> None:
        newest = self.columns[-1].retract(self.offsets[-1])
        self.intervals.append(Interval(newest.time, self.grid.dim))
        self.columns.append(newest.predict(self.settings.knot_period))
        self.offsets.append(np.zeros(self.grid.dim))
        if self.columns[-1].time - self.columns[1].time > self.settings.window - TIME_EPSILON:
            self._marginalise_oldest()

    def _marginalise_oldest(self) -> None:
        """Drop the oldest column and keep its message; its neighbour's linearisation point is then pinned."""
        oldest = self.intervals[0]
        changed = oldest.changed
        if changed:
            oldest.linearise(self.priors, self.columns[0], self.columns[1])
        self.chain.forget_oldest(oldest.blocks, changed)
        del self.columns[0], self.offsets[0], self.intervals[0]
        self._marginalised = True

    # ------------------------------------------------------------------ one step

    def _step(self) -> Estimate | None:
        self._last_cycle, self._cycle, self._cycle_start = self._cycle, set(), None
        if not self.intervals:
            return None
        started = clock.perf_counter()
        with self._threads.limit(limits=1, user_api="blas"):  # small matrices: more threads only wait for one another
            return self._solve(started)

    def _solve(self, started: float) -> Estimate:
        if not self.acquired:
            self._guess_shape()
        try:
            iterations, converged = self._optimise()
        except SingularError:
            self.counts["restarts"]["singular"] += 1
            self._keep_newest_intervals(1)
            iterations, converged = 0, False
        self._finish_rest()
        self._find_suspects()
        if self.tof is not None and self.settings.recovery.enabled:
            self._look_after(converged)
        else:
            self.acquired = self.acquired or converged
        return self._estimate(iterations, converged, clock.perf_counter() - started)

    def _optimise(self) -> tuple[int, bool]:
        """Gauss-Newton with damping when a step fails: (iterations, whether it converged).

        Costs are compared only while acquiring: when tracking, a step starts next to the minimum.
        """
        solver = self.settings.solver
        limit = solver.max_iterations if self.acquired else solver.acquisition_iterations
        damping, first = 0.0, len(self.intervals)
        for iteration in range(1, limit + 1):
            self._set_gate(iteration)
            first = min(first, self._linearise())
            before = None if self.acquired else (self.columns.copy(), self.offsets.copy(), self._cost())
            try:
                offsets = self.chain.solve([interval.blocks for interval in self.intervals], first, damping)
            except SingularError:
                damping, first = max(10.0 * damping, 1e-4), 0
                if damping > DAMPING_LIMIT:
                    raise
                continue
            move = self._largest_move(offsets)
            first = min(self._move(offsets), self._linearise())
            if before is not None and self._cost() > before[2] * (1.0 + COST_SLACK) + 1.0:
                self._undo(*before[:2])
                first, damping = 0, max(10.0 * damping, 1e-3)
                if damping > DAMPING_LIMIT:
                    break
                continue
            if move < solver.tolerance and self._gate_closed():
                return iteration, True
            first, damping = (0, 0.1 * damping if damping > 1e-3 else 0.0) if damping > 0.0 else (first, 0.0)
        if damping > 0.0:  # the covariance must not know of the damping
            self.chain.solve([interval.blocks for interval in self.intervals], 0)
        return limit, False

    def _undo(self, columns: list[Column], offsets: list[np.ndarray]) -> None:
        """Back to where a failed step started."""
        moved = [old is not new for old, new in zip(columns, self.columns, strict=True)]
        self.columns, self.offsets = columns, offsets
        for k, interval in enumerate(self.intervals):
            interval.changed = interval.changed or moved[k] or moved[k + 1]
        if moved[0]:
            self.chain.messages[0] = self._start_message()

    def _linearise(self) -> int:
        """Linearise the intervals that changed; the first of them."""
        changed = [k for k, interval in enumerate(self.intervals) if interval.changed]
        for k in changed:
            self.intervals[k].linearise(self.priors, self.columns[k], self.columns[k + 1])
        return changed[0] if changed else len(self.intervals)

    def _largest_move(self, offsets: list[np.ndarray]) -> float:
        changes = (new - old for new, old in zip(offsets, self.offsets, strict=True))
        return max(float(np.max(np.abs(self._poses(change)))) for change in changes)

    def _poses(self, offset: np.ndarray) -> np.ndarray:
        return offset[:self.grid.bias_offset].reshape(-1, 18)[:, :6]

    def _move(self, offsets: list[np.ndarray]) -> int:
        """Take the offsets; columns that moved far get a new linearisation point. The first interval affected.

        The column that a marginalisation pinned keeps its point (first-estimate Jacobians).
        """
        first = len(self.intervals)
        for k, offset in enumerate(offsets):
            pinned = k == 0 and self._marginalised
            if pinned or np.max(np.abs(self._poses(offset))) < self.settings.solver.relinearise:
                self.offsets[k] = offset
                continue
            self.columns[k] = self.columns[k].retract(offset)
            self.offsets[k] = np.zeros(self.grid.dim)
            if k == 0:
                self.chain.messages[0] = self._start_message()
            for touched in (k - 1, k):
                if 0 <= touched < len(self.intervals):
                    self.intervals[touched].changed = True
                    first = min(first, touched)
        return first

    def _cost(self) -> float:
        """The window's cost: robust where linearised, by the quadratic model at the offsets."""
        start, x = self.chain.messages[0], self.offsets[0]
        total = float(x @ (start.gradient + 0.5 * (start.information @ x)))
        return total + sum(interval.modelled_cost(self.offsets[k], self.offsets[k + 1])
                           for k, interval in enumerate(self.intervals))

    # ------------------------------------------------------------------ the start

    def _guess_shape(self) -> None:
        """Start from the first strain and insertion measured, where there are any, rather than from straight."""
        column = self.columns[0]
        strain, T_base = column.strain.copy(), column.T[0]
        for factor in self.factors:
            rows = self.intervals[0].rows(factor)
            if factor.name == "strain" and rows:
                s, bending, _ = rows[0]
                order = np.argsort(s)
                for i in range(2):
                    strain[:, 4 + i] = np.interp(self.grid.s, s[order], bending[order, i])
            if factor.name == "insertion" and rows:
                T_base = rows[0][1]
        if len(self.columns) == 2 and not self._marginalised:
            self._place(place(self.grid, column, T_base, strain), moving=True)

    def _place(self, shape: Column, moving: bool) -> None:
        """Put the whole window motionless into one shape and forget what came before it."""
        self.columns = [replace(shape, time=old.time) for old in self.columns]
        self.offsets = [np.zeros(self.grid.dim) for _ in self.columns]
        self._restart_chain(moving)

    def _set_gate(self, iteration: int) -> None:
        """Wide at first, when the shape is a guess, then narrowing to the tracking gate."""
        if self.tof is None:
            return
        options = self.settings.tof
        gate = options.gate if self.acquired else max(options.gate, options.acquisition_gate * 0.75**iteration)
        if gate != self.tof.gate:
            self.tof.gate = gate
            for interval in self.intervals:
                interval.changed = True

    def _gate_closed(self) -> bool:
        return self.tof is None or self.tof.gate <= self.settings.tof.gate

    def _note_rest(self, measurement: Measurement) -> None:
        if self._rest is not None and isinstance(measurement, ImuSample):
            self._rest.setdefault(measurement.sensor, []).append(measurement.angular_velocity)

    def _finish_rest(self) -> None:
        """After the initial rest, its average rate enters as an observation of the bias."""
        options = self.settings.gyro
        if self._rest is None or seconds(self.newest, self.epoch) < options.rest_time:
            return
        rest, self._rest = self._rest, None
        if options.rest_time == 0.0 or self._marginalised:
            return
        weight, mean = np.zeros(3 * self.grid.biases), np.zeros(3 * self.grid.biases)
        turned = lie.so3_log(np.swapaxes(self.columns[0].T[:, :3, :3], 1, 2) @ self.columns[-1].T[:, :3, :3])
        for number, imu in enumerate(self.robot.imu):
            rates = np.array(rest.get(imu.name, []))
            node = self.grid.node_at(self.robot.sensor_arclength(imu.name))
            steady = len(rates) >= 10 and np.max(np.std(rates, axis=0)) <= options.rest_rate
            if not steady or np.linalg.norm(turned[node]) > REST_TURN:
                continue
            weight[3 * number:3 * number + 3] = 1.0 / (self.robot.imu_model.gyro_sigma**2 / len(rates) + REST_SIGMA**2)
            mean[3 * number:3 * number + 3] = imu.mount.T_ring_sensor[:3, :3] @ np.mean(rates, axis=0)
        self._rest_bias = weight, mean
        self.chain.messages[0] = self._start_message()
        self.intervals[0].changed = True

    # ------------------------------------------------------------------ lost and found

    def _look_after(self, converged: bool) -> None:
        """Notice a wrong minimum by the worst ring's share of fitting zones, and look for a better body."""
        time = seconds(self.newest, self.epoch)
        fitting = self._worst_share() >= self.settings.recovery.suspect_share
        self.acquired = self.acquired or (converged and fitting)
        due = self.watch.update(time, self._worst_share())
        if due or (not fitting and not self.acquired and time >= self.watch.next_search):
            self.watch.searched(time, confirmed=self._search())

    def _worst_share(self) -> float:
        """Least share of fitting zones over the rings, in the newest interval that has ToF frames; sensors that are
        themselves suspect do not count."""
        fits = self._newest_fits()
        by_ring: dict[str, np.ndarray] = {}
        for sensor in self.robot.tof:
            if sensor.name in fits and sensor.name not in self.suspects:
                by_ring[sensor.ring] = by_ring.get(sensor.ring, 0.0) + fits[sensor.name]
        return min((fit[1] / fit[0] for fit in by_ring.values() if fit[0] > 0), default=1.0)

    def _find_suspects(self) -> None:
        """Sensors that do not fit while the others do: a wrong extrinsic, a wrong clock, a broken part."""
        options, fits = self.settings.recovery, self._fit()[2]
        suspects = []
        for sensors in (self.robot.tof, self.robot.imu):
            names = [sensor.name for sensor in sensors if sensor.name in fits]
            healthy = names and np.median([fits[name] for name in names]) > HEALTHY_SHARE
            suspects += [name for name in names if healthy and fits[name] < options.sensor_share]
        self.suspects = tuple(suspects)
        if self.tof is not None:
            for name in self.tof.weights:
                self.tof.weights[name] = options.suspect_weight if name in suspects else 1.0

    def _newest_fits(self) -> dict[str, np.ndarray]:
        for interval in reversed(self.intervals):
            if "tof" in interval.reports:
                return interval.reports["tof"].fits
        return {}

    def _search(self) -> bool:
        """Try the shapes that a search finds; True when the body that results is to be believed."""
        rows = [row for interval in self.intervals[-2:] for row in interval.rows(self.tof)]
        if not rows:
            return False
        self._keep_newest_intervals(2)
        current = self._snapshot_state()
        best, best_cost, rivals = current, self._fit_cost(), []
        T_base = current[0][-1].T[0]
        for strain in self._shapes.find(T_base, Snapshot.of(rows)):
            self._place(place(self.grid, current[0][-1], T_base, strain), moving=True)
            self.acquired = False
            self._optimise()
            cost, state = self._fit_cost(), self._snapshot_state()
            rivals.append((cost, state[0][-1].T[self.grid.ring_nodes, :3, 3]))
            if cost < best_cost * (1.0 - self.settings.recovery.margin):
                best, best_cost = state, cost
        self._restore(best)
        self.acquired = True
        chosen = best[0][-1].T[self.grid.ring_nodes, :3, 3]
        limit = best_cost * (1.0 + self.settings.recovery.margin)
        return all(np.max(np.linalg.norm(place_ - chosen, axis=1)) < AMBIGUOUS or cost > limit
                   for cost, place_ in rivals)

    def _keep_newest_intervals(self, count: int) -> None:
        """Shorten the window: what led a lost body astray is forgotten."""
        drop = max(len(self.intervals) - count, 0)
        del self.columns[:drop], self.offsets[:drop], self.intervals[:drop]
        self.columns = [column.retract(offset) for column, offset in zip(self.columns, self.offsets, strict=True)]
        self.offsets = [np.zeros(self.grid.dim) for _ in self.columns]
        self._restart_chain(moving=True)
        self._optimise()

    def _fit_cost(self) -> float:
        return sum(report.cost for interval in self.intervals for report in interval.reports.values())

    def _snapshot_state(self) -> tuple[list[Column], list[np.ndarray]]:
        return [c.retract(x) for c, x in zip(self.columns, self.offsets, strict=True)], [np.zeros(self.grid.dim)
                                                                                         for _ in self.columns]

    def _restore(self, state: tuple[list[Column], list[np.ndarray]]) -> None:
        self.columns, self.offsets = list(state[0]), list(state[1])
        self._restart_chain(moving=True)
        self.acquired = True
        self._optimise()

    # ------------------------------------------------------------------ the output

    def _estimate(self, iterations: int, converged: bool, elapsed: float) -> Estimate:
        now = seconds(self.newest, self.epoch)
        before = now - self.settings.lag
        lagged = None
        if self.settings.lag > 0.0 and before >= self.columns[0].time:
            lagged = self._compose(before, converged, iterations, elapsed, None)
        return self._compose(now, converged, iterations, elapsed, lagged)

    def _compose(self, time: float, converged: bool, iterations: int, elapsed: float,
                 lagged: Estimate | None) -> Estimate:
        body, covariance = self._body(time)
        rings = self.grid.ring_nodes
        squared, count, inliers = self._fit()
        return Estimate(
            stamp=self.epoch + round(time * 1e9), T_map_ring=body.T[rings], covariance=covariance[:, :6, :6],
            strain=body.strain[rings], velocity=body.velocity[rings], velocity_covariance=covariance[:, 6:, 6:],
            backbone_s=self._backbone_s,
            T_map_backbone=backbone(self.grid, body.T, body.strain, self._backbone_s),
            status=self._status(), consistency=squared / max(count, 1),
            inliers=inliers, suspects=self.suspects, iterations=iterations, converged=converged, step_seconds=elapsed, lagged=lagged)

    def _status(self) -> str:
        if self.watch.lost:
            return "lost"
        return "tracking" if self.acquired else "initialising"

    def _body(self, time: float) -> tuple[Body, np.ndarray]:
        """The nodes at `time` in the window, and the covariance (R + 1, 12, 12) of each ring's [pose, velocity]."""
        k = int(np.searchsorted([column.time for column in self.columns], time - TIME_EPSILON)) - 1
        k = min(max(k, 0), len(self.intervals) - 1)
        a, b = (self.columns[i].retract(self.offsets[i]) for i in (k, k + 1))
        rings = self.grid.ring_nodes
        rows = (NODE_DIM * rings[:, None] + MOTION).ravel()
        P = self.chain.joint_covariance(k, rows)
        covariance = motion_covariance(a, b, time, rings, P, np.array(self.settings.prior.velocity))
        if self.watch.lost:
            reach = (self.grid.s[rings] / self.grid.s[-1])[:, None]
            sigma = np.repeat(self.settings.recovery.lost_sigma, 3)
            covariance[:, np.arange(6), np.arange(6)] += np.square(reach * sigma)
        return body_between(a, b, time), covariance

    def _fit(self) -> tuple[float, int, dict[str, float]]:
        """Squared normalised residuals and their number over the window, and the share of fitting zones by sensor."""
        squared, count = 0.0, 0
        fits: dict[str, np.ndarray] = {}
        for interval in self.intervals:
            for report in interval.reports.values():
                squared += report.squared
                count += report.count
                for sensor, fit in report.fits.items():
                    fits[sensor] = fits.get(sensor, 0.0) + fit
        return squared, count, {name: float(fit[1] / fit[0]) for name, fit in fits.items() if fit[0] > 0}
