"""The rehearsal of a node: whatever the filter will need is compiled in it."""

from pathlib import Path
import subprocess
import sys

SCRIPT = """
import sys
from continuum_loc import lie
from continuum_loc.estimator import EstimatorSettings, SlidingWindowFilter
from continuum_loc.estimator.state import column_at_rest
from continuum_loc.nodes.support.memory import SeenScene
from continuum_loc.nodes.support.warm_up import warm_up
from continuum_loc.settings import parse_settings
from numba.core.dispatcher import Dispatcher
from worlds import Rod, rod, room_map, stream
from continuum_loc.measurements import TruthSample

def compiled():
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith('continuum_loc'):
            for what, thing in vars(module).items():
                if isinstance(thing, Dispatcher) and thing.overloads:
                    found[f'{thing.py_func.__module__}.{thing.py_func.__name__}'] = len(
                        thing.overloads
                    )
    return found

robot, prior = rod(), room_map()
settings = parse_settings(EstimatorSettings, {'knot_period': 0.1, 'window': 0.6, 'lag': 0.2})
warm_up(robot, prior, settings, SeenScene(robot, prior, 5.0))
before = compiled()
estimator = SlidingWindowFilter(robot, prior, settings)
searched = []
search = estimator.recovery._search
def counted():
    searched.append(search())
    return searched[-1]
estimator.recovery._search = counted
samples = [s for s in stream(Rod(robot, seed=1), 3.0) if not isinstance(s, TruthSample)]
for k, sample in enumerate(samples):
    if k == len(samples) // 2:  # lost: bent elsewhere
        strain = estimator.window.columns[-1].strain.copy()
        strain[:, 4] += 1.5
        time, T, *_ = estimator.window.columns[-1]
        estimator.window.place(column_at_rest(estimator.grid, T[0], strain, time))
    estimator.process(sample)
assert searched, 'the body was never lost: nothing was shown'
late = {name: n for name, n in compiled().items() if n > before.get(name, 0)}
assert not late, f'compiled while data flowed: {late}'
"""


def test_nothing_compiles_after_the_rehearsal():
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, '-c', SCRIPT],
        cwd=here,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
