"""A compiled kernel is that of the present definitions, and is compiled when they change alone."""

import importlib
from pathlib import Path
import pkgutil
import subprocess
import sys
import textwrap

import continuum_loc
from continuum_loc.compiling import kernel, KernelCache
from continuum_loc.definitions import digest_of
from numba.core.dispatcher import Dispatcher
import pytest

INNER = """
from typing import NamedTuple
from continuum_loc.compiling import kernel

FACTOR = 2.0


class Pair(NamedTuple):
    first: float
    second: float


@kernel
def inner(x):
    '''Times a factor.'''
    return FACTOR * x


def unrelated(x):
    return x
"""
OUTER = """
from inner import inner, Pair
from continuum_loc.compiling import kernel


@kernel
def outer(x):
    return inner(x)


@kernel
def first(pair):
    return pair.first
"""
# Prints the results, and how many kernels were loaded and compiled.
RUN = """
from inner import inner, Pair
from outer import first, outer
made = outer(1.0), first(Pair(3.0, 4.0))
print(*made, *(sum(getattr(one, f'_cache_{what}').values())
               for what in ('hits', 'misses') for one in (outer, first)))
"""


@pytest.fixture
def folder(tmp_path):
    write(tmp_path)
    return tmp_path


def write(folder, inner=INNER, outer=OUTER):
    (folder / 'inner.py').write_text(textwrap.dedent(inner))
    (folder / 'outer.py').write_text(textwrap.dedent(outer))


def environment(folder, **more):
    root = Path(continuum_loc.__file__).parents[1]
    # Python takes a file changed within the same second to the same length for what it was.
    own = {'PYTHONDONTWRITEBYTECODE': '1', 'PYTHONPATH': f'{folder}:{root}'}
    return {'PATH': '/usr/bin:/bin', 'HOME': str(folder), **own, **more}


def run(folder, **more):
    """(outer(1), first of (3, 4)), and how many of the two were loaded, and how many compiled."""
    done = subprocess.run(
        [sys.executable, '-c', RUN],
        cwd=folder,
        env=environment(folder, **more),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    outer, first, *counts = map(float, done.stdout.split())
    return (outer, first), sum(counts[:2]), sum(counts[2:]), done.stderr


def entries(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob('*.kernel')}


@pytest.mark.parametrize('where', ['', 'elsewhere'])
def test_what_was_compiled_once_is_loaded_wherever_it_lies(folder, where):
    more = {'NUMBA_CACHE_DIR': str(folder / where)} if where else {}
    assert run(folder, **more)[:3] == ((2.0, 3.0), 0, 2)
    assert all((folder / where) in path.parents for path in entries(folder))
    assert run(folder, **more)[:3] == ((2.0, 3.0), 2, 0)


@pytest.mark.parametrize(
    ('old', 'new', 'result'),
    [
        ('FACTOR = 2.0', 'FACTOR = 3.0', (3.0, 3.0)),
        ('return FACTOR * x', 'return FACTOR * x + 1.0', (3.0, 3.0)),
        ('first: float\n    second: float', 'second: float\n    first: float', (2.0, 4.0)),
    ],
)
def test_a_change_in_another_file_is_compiled_and_nothing_is_removed(folder, old, new, result):
    run(folder)
    before = entries(folder)
    write(folder, INNER.replace(old, new))
    made, loaded, compiled, _ = run(folder)
    assert made == result
    assert (loaded, compiled) == (1, 1)  # the other one does not refer to what has changed
    assert set(before) <= set(entries(folder))


@pytest.mark.parametrize(
    ('old', 'new'),
    [
        ('Times a factor.', 'Multiply by a factor.'),
        ('FACTOR = 2.0', '# of no importance\n\n\nFACTOR = 2.0'),
        ('return x\n', 'return x + 1\n'),  # of the function that nobody calls
    ],
)
def test_words_and_what_is_not_referred_to_compile_nothing(folder, old, new):
    run(folder)
    before = entries(folder)
    write(folder, INNER.replace(old, new), '# moved\n\n' + OUTER)
    (folder / 'figure.py').write_text('another = 1\n')
    assert run(folder)[:3] == ((2.0, 3.0), 2, 0)
    assert entries(folder) == before


def test_where_nothing_can_be_written_it_runs_and_says_so_once(folder):
    (folder / '__pycache__').write_text('')  # no folder, whoever asks: also of root
    made, loaded, compiled, said = run(folder, XDG_CACHE_HOME='/dev/null')
    assert (made, loaded, compiled) == ((2.0, 3.0), 0, 2)
    assert said.count('\n') == 1 and 'set NUMBA_CACHE_DIR' in said


def test_two_instances_at_once_disturb_each_other_in_nothing(folder):
    command = [sys.executable, '-c', RUN]
    both = [
        subprocess.Popen(
            command, cwd=folder, env=environment(folder), stdout=subprocess.PIPE, text=True
        )
        for _ in range(3)
    ]
    said = [one.communicate()[0].split() for one in both]
    assert [tuple(map(float, one[:2])) for one in said] == [(2.0, 3.0)] * 3
    assert run(folder)[:3] == ((2.0, 3.0), 2, 0)
    assert [path for path in folder.rglob('*.kernel*') if path.suffix != '.kernel'] == []


def test_a_damaged_entry_is_compiled_anew(folder):
    run(folder)
    for path in entries(folder):
        path.write_bytes(path.read_bytes()[:-100])
    made, loaded, compiled, said = run(folder)
    assert (made, loaded, compiled) == ((2.0, 3.0), 0, 2)
    assert 'is damaged' in said
    assert run(folder)[:3] == ((2.0, 3.0), 2, 0)


def test_a_full_disk_costs_the_next_start_alone(tmp_path, monkeypatch, caplog):
    import numpy as np

    def full(path, data):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('pathlib.Path.write_bytes', full)
    double = kernel(lambda x: 2.0 * x)
    assert double(np.float32(1.5)) == 3.0
    assert 'No space left on device' in caplog.text


def module(folder, name, text):
    (folder / f'{name}.py').write_text(textwrap.dedent(text))
    importlib.invalidate_caches()
    sys.modules.pop(name, None)
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))


def digests(folder, *texts):
    """Of function `f` of a module that has been written again and again."""
    return [
        digest_of(module(folder / str(k), 'written', text).f)
        for k, text in enumerate(texts)
        if not (folder / str(k)).mkdir()
    ]


PLAIN = """
import numpy as np
from continuum_loc.compiling import kernel

TABLE = np.arange(3)

def shift(x):
    return x + 1

@kernel{options}
def f(x):
    return TABLE[0] + np.sqrt(x) + shift(x)
"""


@pytest.mark.parametrize(
    ('old', 'new'),
    [
        ('np.arange(3)', 'np.arange(1, 4)'),
        ('np.arange(3)', 'np.arange(3.0)'),
        ('x + 1\n', 'x + 2\n'),
        ('np.sqrt', 'np.cbrt'),
        ('{options}', "(inline='always')"),
        ('def f(x):', 'def f(x, y=1):'),
    ],
)
def test_constants_functions_and_options_count(tmp_path, old, new):
    one, other = (text.format(options='') for text in (PLAIN, PLAIN.replace(old, new)))
    if old == '{options}':
        other = PLAIN.format(options=new)
    first, second, again = digests(tmp_path, one, other, one)
    assert first != second
    assert first == again


def test_a_function_that_calls_itself_has_a_digest(tmp_path):
    text = (
        'from continuum_loc.compiling import kernel\n'
        '@kernel\ndef f(x):\n    return g(x - 1) if x > 0 else {}\n'
        '@kernel\ndef g(x):\n    return f(x)\n'
    )
    one, other = digests(tmp_path, text.format(0), text.format(1))
    assert one != other


def test_what_nothing_tells_apart_is_refused(tmp_path):
    text = (
        'from continuum_loc.compiling import kernel\n'
        'THING = object()\n'
        '@kernel\ndef f(x):\n    return THING\n'
    )
    with pytest.raises(TypeError, match='refers to <object object at 0x'):
        digests(tmp_path, text)


def test_every_kernel_of_the_package_is_kept_this_way():
    found = []
    for info in pkgutil.walk_packages(continuum_loc.__path__, 'continuum_loc.'):
        if '.nodes' not in info.name:
            found += [
                one
                for one in vars(importlib.import_module(info.name)).values()
                if isinstance(one, Dispatcher) and one.py_func.__module__ == info.name
            ]
    assert len(found) > 50
    others = [one.py_func for one in found if not isinstance(one._cache, KernelCache)]
    assert others == []
    assert all(digest_of(one) for one in found)
