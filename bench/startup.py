"""
What one waits for before anything happens: import, help, the first estimate, a node.

Each is a fresh process on one core. Kernels are compiled on the first run on a machine and kept;
these rows have them kept. `ours_s` is
the processor time of the process, `wall_s` what the clock on the wall said meanwhile (more, where
the machine is shared), `memory_bytes` the greatest resident size by then. The node is the
estimator with the engine robot and its map, from its start until its log says `ready`: imports,
ROS, map and index loaded, and a throw-away run of the filter that makes sure that everything is
compiled.
"""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from bench.harness import alone, one_core
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import simulate, Trial, write_bag
import numpy as np

BOUNDS = [
    ('startup, first estimate', 'ours_s', 'at most', 5.0),
    ('startup, node ready', 'ours_s', 'at most', 5.0),
]

_ESTIMATE = """
from continuum_loc.offline.localise import make_filter
from continuum_loc.offline.scene_maps import scene_map
from continuum_loc.offline.trials import Trial
from continuum_loc.offline.replay import samples_of
from continuum_loc.measurements import TruthSample
from continuum_loc.robot import load_robot
estimator = make_filter(load_robot("engine"), scene_map("S0"))
made = (estimator.process(s) for s in samples_of({bag!r}) if not isinstance(s, TruthSample))
assert next(e for e in made if e is not None).stamp
print("ready:", flush=True)
input()
"""
READY = b'ready:'


def run(quick: bool = False) -> list[dict]:
    """Rows of name, ours_s, wall_s and memory_bytes: medians over repeats."""
    with tempfile.TemporaryDirectory() as scratch:
        bag, prior = Path(scratch) / 'bag', Path(scratch) / 'map.npz'
        write_bag(bag, simulate(Trial(duration=0.5)))
        scene_map('S0').save(prior)
        parameters = ['-p', f'map:={prior}', '-p', 'robot:=engine']
        node = ['-m', 'continuum_loc.nodes.estimator', '--ros-args', *parameters]
        with one_core():
            return [
                _row('startup, import continuum_loc', ['-c', 'import continuum_loc'], quick),
                _row(
                    'startup, continuum-loc --help', ['-m', 'continuum_loc.cli', '--help'], quick
                ),
                _row('startup, first estimate', ['-c', _ESTIMATE.format(bag=str(bag))], quick),
                _row('startup, node ready', node, quick),
            ]


def _row(name: str, command: list[str], quick: bool) -> dict:
    _until_ready(command)  # compiles, if that has not been done yet
    runs = np.array([_until_ready(command) for _ in range(2 if quick else 7)])
    seconds, wall, memory = np.median(runs, axis=0)
    return alone(name, seconds, wall_s=float(wall), memory_bytes=int(memory) or None)


def _until_ready(command: list[str]) -> tuple[float, float, int]:
    """
    Processor time [s], time on the wall [s] and memory [bytes] of a run of Python.

    It is ended when it says that it is ready; one that never does runs to its end, and its memory
    is not known (0).
    """
    start, process, log, memory = time.perf_counter(), _started(command), b'', 0
    for line in process.stdout:
        log += line
        if READY in line:
            memory = _peak_memory(process.pid)
            process.kill()
    wall = time.perf_counter() - start
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    process.stdin.close()
    process.stdout.close()
    if process.returncode != 0 and not memory:
        raise RuntimeError(f'{command} ended with {process.returncode}:\n{log.decode()}')
    return usage.ru_utime + usage.ru_stime, wall, memory


def _peak_memory(pid: int) -> int:
    """Greatest resident size so far [bytes]: rusage would count the parent's before the fork."""
    status = Path(f'/proc/{pid}/status').read_text()
    return 1024 * int(status.split('VmHWM:')[1].split()[0])


def _started(command: list[str]) -> subprocess.Popen:
    from continuum_loc.offline.domain import Domain

    with Domain() as alone:  # which the process holds as long as it lives
        return subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, 'ROS_DOMAIN_ID': str(alone.number)},
            pass_fds=(alone.lock,),
        )


if __name__ == '__main__':
    for row in run(quick=True):
        print(row)
