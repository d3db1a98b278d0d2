"""
Read inputs of the corpus in a process of their own, whose end is a result like another.

python -m studies._input_worker SEED FOLDER    # numbers of cases, one a line -> results as JSON
"""

from __future__ import annotations

from dataclasses import asdict
import json
import os
from pathlib import Path
import selectors
import shutil
import subprocess
import sys

from studies._input_case import attempt, Case, CRASH, HANG, Result
from studies._input_clouds import cloud_cases
from studies._input_maps import map_cases
from studies._input_meshes import mesh_cases
from studies._input_settings import settings_cases
from studies._input_tables import table_cases
from studies._input_wires import wire_cases

KINDS = (cloud_cases, table_cases, mesh_cases, map_cases, settings_cases, wire_cases)
LIMIT = 10.0  # s: a longer answer is none
START_LIMIT = 120.0  # s: for imports, and for what is compiled once


def all_cases(seed: int) -> list[Case]:
    """Make the corpus, the same for the same seed in every process."""
    return [case for cases in KINDS for case in cases(seed)]


class Worker:
    """A process that reads inputs; it is started anew where one was its end."""

    def __init__(self, seed: int, folder: Path) -> None:
        self._arguments = [str(seed), str(folder)]
        self._process: subprocess.Popen | None = None

    def result(self, number: int) -> Result:
        """Let it read a case."""
        if self._process is None:
            self._start()
        answer = self._ask(str(number), LIMIT)
        if answer is not None:
            return Result(**json.loads(answer))
        status = self._process.poll()
        self.close()
        if status is None:
            return Result(HANG, f'no answer after {LIMIT:g} s', LIMIT)
        return Result(CRASH, f'the process ended with status {status}')

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _start(self) -> None:
        root = str(Path(__file__).parents[1])
        path = os.pathsep.join([root, os.environ.get('PYTHONPATH', '')]).rstrip(os.pathsep)
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'studies._input_worker', *self._arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {'PYTHONPATH': path},
            text=True,
        )
        if self._ask('', START_LIMIT) is None:
            raise RuntimeError('a process that reads inputs did not start')

    def _ask(self, question: str, limit: float) -> str | None:
        """One line for one line; None where it does not come in time, or at all."""
        try:
            if question:
                self._process.stdin.write(question + '\n')
                self._process.stdin.flush()
            with selectors.DefaultSelector() as ready:
                ready.register(self._process.stdout, selectors.EVENT_READ)
                if not ready.select(limit):
                    return None
            return self._process.stdout.readline() or self._ended()
        except BrokenPipeError:
            return self._ended()

    def _ended(self) -> None:
        self._process.wait()


def _warm_up(folder: Path, cases: list[Case]) -> None:
    """Import and compile what the first input of a kind would pay for."""
    for name in ('PCD binary_compressed, f4/f4/f4, 0 paddings', 'mcap, whole', 'our own'):
        _attempt(folder, next(case for case in cases if case.name == name))


def _attempt(folder: Path, case: Case) -> Result:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return attempt(case, folder)


def main(seed: int, folder: Path) -> None:
    """Answer each number on the standard input with a result on the standard output."""
    answers, sys.stdout = sys.stdout, sys.stderr  # nothing else may come between
    cases = all_cases(seed)
    _warm_up(folder, cases)
    print('ready', file=answers, flush=True)
    for line in sys.stdin:
        result = _attempt(folder, cases[int(line)])
        print(json.dumps(asdict(result)), file=answers, flush=True)


if __name__ == '__main__':
    main(int(sys.argv[1]), Path(sys.argv[2]))
