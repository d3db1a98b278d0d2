"""
What one waits for before anything happens: import, help, the map, and the first estimate.

Fresh processes.

Kernels are compiled on the first run on a machine and kept; `startup, first estimate` has them
kept. Memory is the process's greatest resident size at its end.
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

BOUNDS = [('startup, first estimate', 'ours_s', 'at most', 5.0)]

_ESTIMATE = """
import resource
from itertools import takewhile
from continuum_loc.evaluation.trials import Trial, make_filter, scene_map
from continuum_loc.evaluation.replay import samples_of
from continuum_loc.measurements import TruthSample
from continuum_loc.robot import load_robot
estimator = make_filter(load_robot("engine"), scene_map("S0"))
made = (estimator.process(s) for s in samples_of({bag!r}) if not isinstance(s, TruthSample))
assert next(e for e in made if e is not None).stamp
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def run(quick: bool = False) -> list[dict]:
    """Rows of name and ours_s, and `memory_bytes` for the one that estimates."""
    from pathlib import Path
    import tempfile

    from continuum_loc.evaluation.trials import simulate, Trial, write_bag

    repeats = 2 if quick else 7
    with tempfile.TemporaryDirectory() as scratch:
        bag = Path(scratch) / 'bag'
        write_bag(bag, simulate(Trial(duration=0.5)))
        program = _ESTIMATE.format(bag=str(bag))
        commands = {
            'startup, import continuum_loc': ['-c', 'import continuum_loc'],
            'startup, continuum-loc --help': ['-m', 'continuum_loc.cli', '--help'],
            'startup, first estimate': ['-c', program],
        }
        # Builds the map and compiles, if that has not been done yet.
        _timed(commands['startup, first estimate'])
        return [
            _row(name, [_timed(command) for _ in range(repeats)])
            for name, command in commands.items()
        ]


def _timed(command: list[str]) -> tuple[float, str]:
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *command], check=True, capture_output=True, text=True)
    return time.perf_counter() - start, done.stdout


def _row(name: str, runs: list[tuple[float, str]]) -> dict:
    row = {
        'name': name,
        'ours_s': float(np.median([seconds for seconds, _ in runs])),
        'peer': None,
        'peer_s': None,
        'ratio': None,
        'spread': None,
    }
    said = runs[-1][1].strip()
    return row | ({'memory_bytes': 1024 * int(said)} if said.isdigit() else {})
