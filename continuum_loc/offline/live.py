"""
A whole live graph for a limited time: simulator, estimator and recorder as processes of their own.

`run_live` is what `continuum-loc demo` calls. Nothing here imports rclpy: the caller's process
joins no graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from continuum_loc.errors import LiveError
from continuum_loc.offline.domain import Domain
from continuum_loc.offline.trial_runs import trial_map_file
from continuum_loc.offline.trials import Trial

START_LIMIT = 180.0  # s; the first run compiles
STOP_LIMIT = 30.0
DURATION = 20.0  # s of a trial that has none of its own
POLL = 0.1


@dataclass(frozen=True)
class LiveResult:
    """
    What a live run left behind.

    bag: folder of the recorded bag, None where none was recorded.
    latency_ms, lag_ms, step_ms: count, mean, p50, p95, p99, max
    of the delay from sensor stamp to published pose, from reception to published pose, and of the
    filter step. latencies_s: each latency. counts: per node, what was published, received, used,
    refused, dropped and written.
    lost: messages that were published but never reached the estimator or the bag, by topic.
    """

    bag: Path | None
    latency_ms: dict[str, float]
    lag_ms: dict[str, float]
    step_ms: dict[str, float]
    latencies_s: list[float]
    counts: dict[str, Any]
    lost: dict[str, int]
    logs: tuple[Path, ...] = field(default=())


class _Process:
    """One node: its log goes to a file, which is quoted when it fails."""

    def __init__(
        self,
        node: str,
        parameters: dict[str, Any],
        folder: Path,
        environment: dict[str, str],
        domain: Domain,
    ) -> None:
        self.node, self.log = node, folder / f'{node}.log'
        arguments = [
            part
            for name, value in parameters.items()
            for part in ('-p', f'{name}:={_yaml(value)}')
        ]
        with self.log.open('w') as log:
            self._popen = subprocess.Popen(
                [sys.executable, '-m', f'continuum_loc.nodes.{node}', '--ros-args', *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment | {'ROS_DOMAIN_ID': str(domain.number)},
                pass_fds=(domain.lock,),
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        return self._popen.pid

    def running(self) -> bool:
        """Whether it runs; raises LiveError where it failed."""
        code = self._popen.poll()
        if code not in (None, 0):
            tail = '\n'.join(self.log.read_text(errors='replace').splitlines()[-15:])
            raise LiveError(f'node {self.node} ended with {code}; the end of {self.log}:\n{tail}')
        return code is None

    def await_log(self, text: str, limit: float) -> None:
        """Wait until the node's log says `text`."""
        deadline = time.monotonic() + limit
        while text not in self.log.read_text(errors='replace'):
            if not self.running():
                raise LiveError(f'node {self.node} ended before it was ready; see {self.log}')
            if time.monotonic() > deadline:
                raise LiveError(
                    f'node {self.node} was not ready after {limit:g} s; see {self.log}'
                )
            time.sleep(POLL)

    def stop(self) -> None:
        """Ask it to end, and wait; raises LiveError where it failed or would not."""
        if self._popen.poll() is None:
            self._popen.send_signal(signal.SIGINT)
        try:
            self._popen.wait(STOP_LIMIT)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            raise LiveError(
                f'node {self.node} did not stop within {STOP_LIMIT:g} s; see {self.log}'
            ) from None
        self.running()

    def kill(self) -> None:
        """End it at once, if it still runs."""
        if self._popen.poll() is None:
            self._popen.kill()
            self._popen.wait()


def run_live(
    folder: str | Path,
    trial: Trial,
    *,
    record: bool = True,
    progress: Callable[[str, float], None] | None = None,
    watch: Callable[[dict[str, int]], None] | None = None,
) -> LiveResult:
    """
    Simulate, estimate and record a trial live over real ROS 2 (20 s where it has no duration).

    The bag is `folder`/bag; `record` says whether there is one.
    The graph has a ROS domain that nobody else uses (`Domain`).
    progress(stage, share): called as it goes on, share in [0, 1]. watch(process ids by node):
    called ten times a second while data flows. Raises LiveError where a node fails; no process is
    left behind.
    """
    duration = DURATION if trial.duration is None else trial.duration
    folder = Path(folder).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda stage, share: None)
    with _Graph(folder) as graph:
        tell('starting the nodes', 0.0)
        listeners = _listeners(graph, record, trial)
        # The simulator holds its data back until all of them listen to it.
        simulator = graph.start(
            'simulator',
            robot=trial.robot,
            plant=trial.plant or '',
            scene=trial.scene,
            trajectory=trial.trajectory,
            duration=float(duration),
            seed=trial.seed,
            profile=trial.profile,
            tof_fidelity=trial.fidelity,
            world=trial.world,
            wait_for=len(listeners),
        )
        _follow(simulator, listeners, duration, tell, watch)
        time.sleep(0.5)  # the last estimate is still on its way into the bag
        for process in (simulator, *reversed(listeners)):
            process.stop()
    return _result(folder, record, tuple(process.log for process in graph.started))


class _Graph:
    """Nodes in a ROS domain of their own; none is left behind."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._environment = folder, _environment()
        self._domain = Domain()
        self.started: list[_Process] = []

    def __enter__(self) -> _Graph:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self.started:
            process.kill()
        self._domain.close()

    def start(self, node: str, **parameters: Any) -> _Process:
        """Start a node that writes its summary into the folder."""
        path = self.folder / f'{node}.json'
        path.unlink(missing_ok=True)
        parameters['summary_file'] = str(path)
        self.started.append(
            _Process(node, parameters, self.folder, self._environment, self._domain)
        )
        return self.started[-1]


def _listeners(graph: _Graph, record: bool, trial: Trial) -> list[_Process]:
    """Start what listens to the sensors: the recorder, where one is wanted, and the estimator."""
    # The simulator publishes reliably, so on a busy machine nothing need be lost on the way.
    bag = str(graph.folder / 'bag')
    listeners = [graph.start('recorder', bag=bag, reliable_inputs=True)] if record else []
    estimator = graph.start(
        'estimator',
        robot=trial.robot,
        map=str(trial_map_file(trial)),
        **{'intake.reliable_inputs': True},
    )
    for recorder in listeners:
        recorder.await_log('recording', START_LIMIT)
    estimator.await_log('ready:', START_LIMIT)
    return [*listeners, estimator]


def _follow(
    simulator: _Process,
    others: list[_Process],
    duration: float,
    tell: Callable[[str, float], None],
    watch: Callable[[dict[str, int]], None] | None,
) -> None:
    ids = {process.node: process.pid for process in (simulator, *others)}
    begin: float | None = None
    while simulator.running():
        for process in others:
            if not process.running():
                raise LiveError(
                    f'node {process.node} ended while the data was flowing; see {process.log}'
                )
        if begin is None and 'data begins' in simulator.log.read_text(errors='replace'):
            begin = time.monotonic()
        if begin is not None:
            tell('live', min((time.monotonic() - begin) / duration, 1.0))
            if watch is not None:
                watch(ids)
        time.sleep(POLL)
    tell('live', 1.0)


def _environment() -> dict[str, str]:
    """
    Make the children's environment.

    A graph on this machine alone, and one thread for each numerical library.
    """
    own = {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'OMP_NUM_THREADS': '1',
        'OPENBLAS_NUM_THREADS': '1',
        'PYTHONUNBUFFERED': '1',
    }
    # Where the ROS packages come as wheels, they mark the environment that they have set up: a
    # child does its own.
    dropped = ('_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'ROS_STATIC_PEERS')
    return {name: value for name, value in os.environ.items() if name not in dropped} | own


def _yaml(value: Any) -> str:
    return json.dumps(value)


def _result(folder: Path, recorded: bool, logs: tuple[Path, ...]) -> LiveResult:
    read = {log.stem: json.loads(log.with_suffix('.json').read_text()) for log in logs}
    estimator, published = read['estimator'], read['simulator']['published']
    sensors = {topic: count for topic, count in published.items() if topic != 'ground_truth/poses'}
    lost = _missing('estimator', sensors, estimator['counts']['received'])
    counts = {
        'simulator': {'published': published, 'delay_ms': read['simulator']['delay_ms']},
        'estimator': estimator['counts'],
        'filter': estimator['filter'],
    }
    if recorded:
        written = read['recorder']['written']
        lost = _missing('bag', published, written) | lost
        counts['recorder'] = {'written': written}
    return LiveResult(
        bag=folder / 'bag' if recorded else None,
        latency_ms=estimator['latency_ms'],
        lag_ms=estimator['lag_ms'],
        step_ms=estimator['step_ms'],
        latencies_s=estimator['latencies_s'],
        counts=counts,
        lost=lost,
        logs=logs,
    )


def _missing(where: str, sent: dict[str, int], came: dict[str, int]) -> dict[str, int]:
    """How many of the messages of each topic never came; topics of which all came are left out."""
    missing = {topic: count - came.get(topic, 0) for topic, count in sent.items()}
    return {f'{topic} -> {where}': count for topic, count in missing.items() if count}
