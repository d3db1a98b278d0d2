"""
Run a filter over recorded measurements without a ROS graph.

What it gets has passed the same gate (`intake.Intake`) as in a live node, with the log of the bag
as the clock. The same bag gives the same estimate, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
import hashlib
from pathlib import Path
import time
from typing import Any, Protocol

from continuum_loc.errors import BagError, MessageError
from continuum_loc.estimate import Estimate
from continuum_loc.intake import Intake
from continuum_loc.measurements import (
    BaseSample,
    EncoderSample,
    FieldSample,
    ImuSample,
    Measurement,
    NANOSECONDS,
    seconds,
    StrainSample,
    TOF_HALF_CONFIDENT,
    TOF_VALID,
    TofFrame,
    TrackedPose,
    TruthSample,
)
from continuum_loc.offline.account import BAG, Suspicion, TRUTH
from continuum_loc.robot import RobotDescription
from continuum_loc.trajectory import known_at, Trajectory
from msg_tools.factory import deserialize
from msg_tools.topics import INPUTS, topic_of, TRACKER
import numpy as np
from threadpoolctl import threadpool_limits

SAMPLES = (
    TofFrame,
    ImuSample,
    StrainSample,
    FieldSample,
    TrackedPose,
    EncoderSample,
    BaseSample,
    TruthSample,
)
CLOUD_PERIOD = NANOSECONDS // 4  # of each sensor, one frame in this time is kept for pictures


class Filter(Protocol):
    """What `replay` asks of a filter; `SlidingWindowFilter` is one."""

    robot: RobotDescription
    counts: dict[str, Any]

    def process(self, measurement: Measurement) -> Estimate | None: ...
    def flush(self) -> Estimate | None: ...
    def reset(self) -> None: ...


@dataclass(frozen=True, eq=False)
class Cloud:
    """
    M time-of-flight points as the estimate places them.

    Stamps (M,) ns, points (M, 3) in `map` [m].
    """

    stamps: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """
    What a run of the filter gave.

    track: the body at the newest instant of each step; lagged: the same at the smoothing lag (may
    be empty).
    truth: recorded truth (may be empty).
    consistency: (K,) mean normalised innovation squared at each step of `track`.
    step_seconds: (N,) time of each step; latency_seconds: (N,) from sensor stamp to published pose
    (live runs only).
    processing_seconds, data_seconds: time spent in the filter, and time that the data spans.
    cpu_seconds: processor time of the same, over all threads: less than the former where others
    use the machine.
    cloud: a share of the ToF points; counts: what the filter received, used and dropped, and why.
    """

    track: Trajectory
    lagged: Trajectory
    truth: Trajectory
    consistency: np.ndarray
    step_seconds: np.ndarray
    processing_seconds: float
    data_seconds: float
    cloud: Cloud
    counts: dict[str, Any]
    latency_seconds: np.ndarray = field(default_factory=lambda: np.empty(0))
    cpu_seconds: float = float('nan')

    @property
    def real_time_factor(self) -> float:
        """Divide data time by processing time; nan when there was nothing to estimate."""
        return (
            self.data_seconds / self.processing_seconds if len(self.step_seconds) else float('nan')
        )

    @property
    def digest(self) -> str:
        """Hash of every stamp, pose and covariance: equal for equal estimates, to the last bit."""
        hashed = hashlib.sha256()
        for track in (self.track, self.lagged):
            for values in (track.stamps, track.T_map_ring, track.covariance):
                hashed.update(b'-' if values is None else np.ascontiguousarray(values).tobytes())
        return hashed.hexdigest()


def samples_of(bag: str | Path) -> Iterator[Measurement | TruthSample]:
    """Measurements and truth of a recorded bag, in the order of recording."""
    from msg_tools.bag import read_bag

    return (item for _, item in read_bag(Path(bag)) if isinstance(item, SAMPLES))


def replay(
    source: str | Path | Iterable[Measurement | TruthSample],
    estimator: Filter,
    *,
    namespace: str = '',
    frame_prefix: str = '',
    strict: bool = False,
    progress: Callable[[float], None] = lambda elapsed: None,
) -> ReplayResult:
    """
    Feed a bag (its path) or samples in stamp order to `estimator`.

    It runs in this thread, as fast as it goes. What cannot be used is counted, and the rest used;
    where the estimator fails on what a bag gave it, that is counted too, and it starts anew.
    `strict`: the first of either is raised. namespace, frame_prefix: those of the robot in a bag
    of several. progress: told the time of the log [s]. Raises BagError where the bag cannot be
    read.
    """
    intake = Intake(estimator.robot, frame_prefix=frame_prefix, strict=strict)
    with one_thread():
        if not isinstance(source, (str, Path)):
            return _replay(_given(source, intake), estimator, intake)
        inputs = getattr(estimator, 'inputs', (*INPUTS, TRACKER))
        offered = _recorded(Path(source), inputs, intake, namespace, progress)
        return _replay(offered, estimator, intake, intake.attempt)


def _given(samples: Iterable[Measurement | TruthSample], intake: Intake) -> Iterator:
    """(topic, sample) of those that pass the gate."""
    for sample in samples:
        topic = topic_of(sample)
        passed = intake.admit(topic, sample, sample.stamp)
        if passed is not None:
            yield topic, passed


def _recorded(
    bag: Path,
    inputs: tuple[str, ...],
    intake: Intake,
    namespace: str,
    progress: Callable[[float], None],
) -> Iterator:
    """(topic, sample) of a bag's messages that pass the gate."""
    from msg_tools.bag import raw_messages

    def mistyped(topic: str, count: int, text: str) -> None:
        if topic in inputs:
            intake.received[topic] += count
            intake.refuse('type', text, topic, count)

    first = None
    try:
        for topic, logged, data in raw_messages(bag, (*inputs, TRUTH), namespace, mistyped):
            first = logged if first is None else first
            progress(seconds(logged, first))
            message = intake.parse(topic, data, deserialize)
            sample = None if message is None else intake.accept(topic, message, logged)
            if sample is not None:
                yield topic, sample
    except MessageError as error:  # a strict gate's
        raise BagError(f'{bag}: {error} (logged at {logged / NANOSECONDS:.6f} s)') from None
    except BagError as error:
        if first is None:
            raise
        intake.refuse('damaged', str(error), BAG)  # from here on: what came before is used


def one_thread() -> threadpool_limits:
    """
    Limit numeric libraries to one thread; as a context manager, until its end.

    On more threads BLAS sums in another order. Left to the machine, to the environment and to
    what a cluster sets for its workers, the same bag would give another last bit.
    """
    import scipy.linalg  # noqa: F401  # brings a BLAS of its own: limited only once loaded

    return threadpool_limits(1)


def _replay(
    offered: Iterator,
    estimator: Filter,
    intake: Intake,
    attempt: Callable[[Callable[[], None], str], None] = lambda action, what: action(),
) -> ReplayResult:
    log = _Log(estimator.robot)

    def restart() -> None:
        estimator.reset()
        log.restart()

    intake.restart = restart
    for topic, sample in offered:
        if isinstance(sample, TruthSample):
            log.truth.append(sample)
            continue
        log.received(sample)
        attempt(lambda sample=sample: log.step(estimator.process, sample), topic)
    attempt(lambda: log.step(estimator.flush), 'the end')
    return log.result({**estimator.counts, 'intake': intake.counts()})


class _Log:
    """Gathers what passes while the filter runs."""

    def __init__(self, robot: RobotDescription) -> None:
        self.robot = robot
        self.truth: list[TruthSample] = []
        self.estimates: list[Estimate] = []
        self.frames: list[TofFrame] = []
        self.step_seconds: list[float] = []
        self.processing_seconds = self.cpu_seconds = 0.0
        self.data_time = 0  # ns
        self.suspicion = Suspicion()
        self.restart()

    def restart(self) -> None:
        """Start anew: earlier and later stamps have nothing in common."""
        self._span: tuple[int, int] | None = None
        self._next_frame: dict[str, int] = {}

    def received(self, sample: Measurement) -> None:
        first, last = self._span or (sample.stamp, sample.stamp)
        self._span = min(first, sample.stamp), max(last, sample.stamp)
        self.data_time += (self._span[1] - self._span[0]) - (last - first)
        if isinstance(sample, TofFrame) and sample.stamp >= self._next_frame.get(sample.sensor, 0):
            self.frames.append(sample)
            self._next_frame[sample.sensor] = sample.stamp + CLOUD_PERIOD

    def step(self, call: Any, *arguments: Measurement) -> None:
        start, cpu = time.perf_counter(), time.process_time()
        estimate = call(*arguments)
        elapsed = time.perf_counter() - start
        self.cpu_seconds += time.process_time() - cpu
        self.processing_seconds += elapsed
        if estimate is not None:
            self.estimates.append(estimate)
            self.step_seconds.append(elapsed)
            self.suspicion.note(estimate)

    def result(self, counts: dict[str, Any]) -> ReplayResult:
        names = self.robot.ring_names
        latest = {estimate.stamp: estimate.consistency for estimate in self.estimates}
        track = Trajectory.from_estimates(self.estimates, names)
        return ReplayResult(
            track=track,
            lagged=Trajectory.from_estimates(
                (e.lagged for e in self.estimates if e.lagged is not None), names
            ),
            truth=Trajectory.from_truth(self.truth, names),
            consistency=np.array([latest[stamp] for stamp in sorted(latest)], float),
            step_seconds=np.array(self.step_seconds),
            processing_seconds=self.processing_seconds,
            data_seconds=seconds(self.data_time),
            cloud=place_points(self.frames, track, self.robot),
            counts={**counts, 'suspects': self.suspicion.table()},
            cpu_seconds=self.cpu_seconds,
        )


def place_points(frames: Iterable[TofFrame], track: Trajectory, robot: RobotDescription) -> Cloud:
    """Place the valid points of `frames` in `map`, by the pose of their ring at their stamp."""
    frames = list(frames)
    known = known_at(
        track.stamps, np.array([frame.stamp for frame in frames], np.int64), longest_gap=1.0
    )
    frames = [frame for frame, usable in zip(frames, known, strict=True) if usable]
    if not frames:
        return Cloud(np.empty(0, np.int64), np.empty((0, 3)))
    stamps = np.array([frame.stamp for frame in frames], np.int64)
    columns = [track.names.index(robot.sensor(frame.sensor).ring) for frame in frames]
    T_ring_sensor = np.stack([robot.sensor(frame.sensor).mount.T_ring_sensor for frame in frames])
    T_map_sensor = track.at(stamps)[np.arange(len(frames)), columns] @ T_ring_sensor
    placed, at = [], []
    for T, frame in zip(T_map_sensor, frames, strict=True):
        valid = np.isin(frame.status, (TOF_VALID, *TOF_HALF_CONFIDENT)) & np.isfinite(
            frame.points
        ).all(axis=1)
        placed.append(frame.points[valid] @ T[:3, :3].T + T[:3, 3])
        at.append(np.full(valid.sum(), frame.stamp, np.int64))
    return Cloud(np.concatenate(at), np.concatenate(placed))
