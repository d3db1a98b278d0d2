"""What is said while kernels are compiled: their number, now and then, and at the end."""

from continuum_loc.nodes.support import progress
from numba import njit


def test_compiled_kernels_are_counted_and_told_now_and_then(monkeypatch):
    monkeypatch.setattr(progress, 'EVERY', -1.0)  # at each
    said = []
    with progress.compiling(said.append):
        for number in range(2):
            njit(lambda x, number=number: x + number)(1.0)
    assert said[0] == 'compiling, or loading what an earlier run compiled'
    assert said[1].startswith('compiling: 1 kernels in ')
    assert said[-1].startswith('compiled 2 kernels in ')


def test_where_nothing_is_compiled_that_is_said():
    said = []
    with progress.compiling(said.append):
        pass
    assert said[-1].startswith('loaded all kernels in ') and len(said) == 2
