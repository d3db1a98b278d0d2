"""Results are tied to the code that made them, and do not hang on how many threads it has."""

import subprocess
import sys

from continuum_loc.offline import source
from continuum_loc.offline.replay import replay
from continuum_loc.offline.trials import (
    make_filter,
    scene_map,
    simulate,
    Trial,
    trial_settings,
)
from continuum_loc.robot import load_robot
import pytest
from threadpoolctl import threadpool_limits

CODE = 'def f(x):\n    return x + 1\n'

# Prints the files of the packages' modules that a trial has loaded.
LOADED = """
import sys
from pathlib import Path
from continuum_loc.offline.trials import Trial, {what}
trial = Trial('soft_arm', 'R0', 'b1', 'R0', fidelity='vl53l5cx', disturbed=True, duration=0.4)
{work}
for name, module in sys.modules.items():
    if name.partition('.')[0] in ('continuum_loc', 'msg_tools'):
        print(Path(module.__file__).resolve())
"""


@pytest.fixture
def digest(tmp_path):
    def of(text, name='module.py'):
        (tmp_path / name).write_text(text)
        return source.digest_of([tmp_path / name])

    return of


@pytest.mark.parametrize(
    'other',
    [
        'def f(x):  # a comment\n    return x + 1\n',
        'def f(x):\n    """What it does."""\n    return x + 1\n',
        'def f(x):\n\n    return (x +\n            1)\n',
    ],
)
def test_words_about_the_code_do_not_change_its_digest(digest, other):
    assert digest(other) == digest(CODE)


@pytest.mark.parametrize(
    'other', ['def f(x):\n    return x + 2\n', 'def f(x):\n    "What"\n    return "What"\n']
)
def test_other_code_has_another_digest(digest, other):
    assert digest(other) != digest(CODE)


def test_presets_count_to_the_byte(digest):
    assert digest('rate: 15\n', 'a.yaml') != digest('rate: 16\n', 'a.yaml')


@pytest.mark.parametrize(
    ('what', 'work', 'without', 'known_otherwise'),
    [
        # The scene enters a replay through its map, whose name holds a digest of the mesh.
        ('run_trial', 'run_trial(trial)', source.NOT_REPLAYED, ['/simulator/']),
        (
            'simulate',
            'list(simulate(trial))',
            source.NOT_SIMULATED,
            # The replay's interface is imported beside what simulates, and names what it returns.
            ['/evaluation/', '/estimator/__init__.py', '/estimator/estimate.py'],
        ),
    ],
)
def test_all_that_a_trial_runs_is_in_its_digest(what, work, without, known_otherwise):
    program = LOADED.format(what=what, work=work)
    said = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True
    ).stdout
    covered = {str(path.resolve()) for path in source.files(source.NEITHER + without)}
    missing = [
        path
        for path in said.split()
        if path not in covered and not any(part in path for part in known_otherwise)
    ]
    assert said.count('.py') > 20
    assert missing == []


def test_a_replay_does_not_hang_on_the_number_of_threads():
    # Two threads gave another last bit from the 39th estimate of this recording on.
    trial = Trial(
        'soft_arm', 'R1', 'b2', 'R0', fidelity='vl53l5cx', disturbed=True, seed=0, duration=3.0
    )
    samples = list(simulate(trial))
    digests = set()
    for threads in (1, 2):
        with threadpool_limits(threads):
            estimator = make_filter(
                load_robot(trial.robot), scene_map(trial.map_scene), trial_settings(trial)
            )
            digests.add(replay(iter(samples), estimator).digest)
    assert len(digests) == 1
