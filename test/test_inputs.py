"""
The corpus of inputs: every cloud, mesh, map and settings file of it comes out as is right for it.

And the study notices what must not be: a wrong value, a crash, silence.
"""

import json
import os
import signal
import sys
import time

from continuum_loc.errors import MapError
import pytest
from studies import _input_worker, inputs
from studies._input_case import (
    ACCEPTED,
    attempt,
    Case,
    CHANGED,
    CRASH,
    EITHER,
    HANG,
    READ,
    REFUSED,
    REFUSED_GOOD,
    Result,
    RIGHT,
    UNCLEAR,
)
from studies._input_worker import all_cases, KINDS, Worker

SEED = 3  # another than the study's
SHARES = 8


@pytest.mark.parametrize('share', range(SHARES))
def test_every_cloud_mesh_map_and_settings_file_comes_out_right(tmp_path, share):
    cases = [case for kind in KINDS[:-1] for case in kind(SEED)]  # without bags and lines
    assert len(cases) > 500
    for number in range(share, len(cases), SHARES):
        folder = tmp_path / str(number)
        folder.mkdir()
        result = attempt(cases[number], folder)
        assert result.verdict == RIGHT, (cases[number].kind, cases[number].name, result.said)
        assert result.memory_mb < inputs.MOST_MEMORY and result.seconds < _input_worker.LIMIT


def test_the_corpus_is_the_same_for_the_same_seed_and_large_enough():
    names = [(case.kind, case.name) for case in all_cases(0)]
    assert names == [(case.kind, case.name) for case in all_cases(0)]
    assert len(names) >= inputs.LEAST
    assert {kind for kind, _ in names} == {'cloud', 'mesh', 'map', 'settings', 'bag', 'line'}


def case(read, right, judge=lambda value: ''):
    return Case('cloud', 'a', lambda folder: folder / 'a.xyz', read, right, judge)


def refuse(text):
    def read(path):
        raise MapError(text)

    return read


@pytest.mark.parametrize(
    ('tried', 'verdict'),
    [
        (case(lambda path: 1, READ), RIGHT),
        (case(lambda path: 1, READ, lambda value: 'off by 1'), CHANGED),
        (case(lambda path: 1, EITHER, lambda value: 'off by 1'), CHANGED),
        (case(lambda path: 1, REFUSED), ACCEPTED),
        (case(refuse('a.xyz: empty'), REFUSED), RIGHT),
        (case(refuse('a.xyz: empty'), EITHER), RIGHT),
        (case(refuse('a.xyz: empty'), READ), REFUSED_GOOD),
        (case(refuse('something is wrong'), REFUSED), UNCLEAR),
        (case(refuse('a.xyz: ' + 'x' * 1000), REFUSED), UNCLEAR),
        (case(lambda path: {}['x'], REFUSED), CRASH),
    ],
)
def test_a_verdict_is_what_was_right_and_what_came(tmp_path, tried, verdict):
    assert attempt(tried, tmp_path).verdict == verdict


def test_memory_that_reading_takes_is_seen(tmp_path):
    large = case(lambda path: bytearray(200_000_000).count(1), READ)
    assert 150.0 < attempt(large, tmp_path).memory_mb < 400.0
    assert attempt(case(lambda path: 1, READ), tmp_path).memory_mb < 50.0


@pytest.mark.parametrize(
    ('verdict', 'claim'),
    [
        (CRASH, 'end the process'),
        (HANG, 'without an answer'),
        (CHANGED, 'changed values'),
        (ACCEPTED, 'bad inputs accepted'),
        (REFUSED_GOOD, 'good inputs refused'),
        (UNCLEAR, 'do not name'),
    ],
)
def test_one_wrong_input_fails_its_claim_and_no_other(verdict, claim):
    good = [(case(None, READ), Result(RIGHT))] * 400
    assert all(one.holds for one in inputs.judge(good))
    claims = inputs.judge([*good, (case(None, READ), Result(verdict))])
    assert [claim in one.name for one in claims] == [not one.holds for one in claims]


class Scripted(Worker):
    """A worker whose process does what a text of Python says, once it is ready."""

    def __init__(self, script):
        super().__init__(0, None)
        self._script = script

    def _start(self):
        code = f"import os, signal, time\nprint('ready', flush=True)\n{self._script}"
        self._process = _input_worker.subprocess.Popen(
            [sys.executable, '-c', code],
            stdin=_input_worker.subprocess.PIPE,
            stdout=_input_worker.subprocess.PIPE,
            text=True,
        )
        assert self._ask('', 30.0) == 'ready\n'


def test_a_process_that_ends_or_does_not_answer_is_a_result(monkeypatch):
    monkeypatch.setattr(_input_worker, 'LIMIT', 0.5)
    good = json.dumps({'verdict': RIGHT, 'said': '', 'seconds': 0.1, 'memory_mb': 1.0})
    worker = Scripted(f'while True:\n    input()\n    print({good!r}, flush=True)')
    assert [worker.result(k).verdict for k in range(3)] == [RIGHT] * 3
    worker.close()
    dead = Scripted('input()\nos.kill(os.getpid(), signal.SIGSEGV)')
    found = dead.result(0)
    assert (found.verdict, found.said) == (
        CRASH,
        f'the process ended with status {-signal.SIGSEGV}',
    )
    assert dead.result(1).verdict == CRASH  # by a process started anew
    start = time.monotonic()
    silent = Scripted('time.sleep(60)')
    assert silent.result(0).verdict == HANG
    assert time.monotonic() - start < 20.0


def test_a_real_worker_reads_a_case(tmp_path):
    numbers = {one.name: k for k, one in enumerate(all_cases(0))}
    worker = Worker(0, tmp_path / 'files')
    try:
        result = worker.result(numbers['PLY ascii, f4/f4/f4, LF'])
    finally:
        worker.close()
    assert (result.verdict, result.said) == (RIGHT, '')
    assert os.listdir(tmp_path / 'files') == ['cloud.ply']
