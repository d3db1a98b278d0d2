"""A compiled kernel is never older than what it was compiled from."""

import os
import subprocess
import sys

from continuum_loc.kernel_cache import forget_stale_kernels
import pytest

INNER = 'from numba import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return {} * x\n'
OUTER = (
    'from numba import njit\nfrom inner import inner\n\n\n'
    '@njit(cache=True)\ndef outer(x):\n    return inner(x)\n'
)


def write(folder, factor):
    (folder / 'inner.py').write_text(INNER.format(factor))
    (folder / 'outer.py').write_text(OUTER)


def outer_of_one(folder):
    environment = {k: v for k, v in os.environ.items() if k != 'NUMBA_CACHE_DIR'}
    command = [sys.executable, '-c', 'from outer import outer; print(outer(1.0))']
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return float(done.stdout)


def test_a_kernel_follows_a_change_in_another_file(tmp_path):
    write(tmp_path, 2.0)
    assert outer_of_one(tmp_path) == 2.0
    assert forget_stale_kernels(tmp_path) == 0
    (tmp_path / 'inner.py').write_text(INNER.format(3.0))
    assert outer_of_one(tmp_path) == 2.0, 'numba asks for more by now: forget kernel_cache'
    (tmp_path / 'inner.py').write_text(INNER.format(5.0))
    assert forget_stale_kernels(tmp_path) > 0
    assert outer_of_one(tmp_path) == 5.0


def test_only_what_is_older_than_the_newest_source_is_removed(tmp_path):
    cache = tmp_path / 'part' / '__pycache__'
    cache.mkdir(parents=True)
    for name, age in (('a.nbi', 1), ('b.nbi', 3), ('c.txt', 1)):
        (cache / name).write_text('')
        os.utime(cache / name, (age, age))
    source = tmp_path / 'part' / 'a.py'
    source.write_text('')
    os.utime(source, (2, 2))
    assert forget_stale_kernels(tmp_path) == 1
    assert sorted(path.name for path in cache.iterdir()) == ['b.nbi', 'c.txt']


def test_a_stale_kernel_that_cannot_be_removed_is_an_error(tmp_path, monkeypatch):
    write(tmp_path, 2.0)
    cache = tmp_path / '__pycache__'
    cache.mkdir()
    (cache / 'outer.nbi').write_text('')
    os.utime(cache / 'outer.nbi', (1, 1))

    def refused(path, missing_ok=False):
        raise PermissionError(13, 'Permission denied')

    monkeypatch.setattr('pathlib.Path.unlink', refused)
    with pytest.raises(ImportError, match=r'outer\.nbi .* \(Permission denied\)'):
        forget_stale_kernels(tmp_path)
