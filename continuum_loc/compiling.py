"""
Where every compiled function of this package is made, and kept on disk.

A `kernel` is numba's `njit` with a cache of its own. Numba's asks for the age of the file that a
function stands in. That is too little, since what it compiles holds the functions and constants
that it names, from whichever file; and too much, since a word in a comment throws it away. Here
an entry carries a digest of all that it was compiled from (`definitions`), and one that says
something else is compiled anew. An entry is one file, which is replaced at once: of two processes
that compile the same, the last one's stays, and no reader meets half of either.

Entries lie where numba keeps its own: in NUMBA_CACHE_DIR, beside the source, or in the user's
cache folder. Where none of them can be written everything is compiled at each start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property, partial
import hashlib
import logging
import os
from pathlib import Path
import pickle
import sys
from typing import Any

from continuum_loc.definitions import digest_of
import llvmlite
import numba
from numba import njit, types
from numba.core import sigutils
from numba.core.caching import CompileResultCacheImpl, NullCache
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

VERSIONS = f'numba {numba.__version__}, llvmlite {llvmlite.__version__}'
SUFFIX = '.kernel'

_log = logging.getLogger(__name__)
_said: set[str] = set()


def kernel(function: Callable | None = None, /, **options: Any) -> Callable:
    """
    Compile a function at its first call, and keep what was compiled on disk.

    Used bare, or with options of numba's `njit`: `@kernel(inline='always')`.
    """
    if function is None:
        return partial(kernel, **options)
    compiled = njit(**options)(function)
    if isinstance(compiled, Dispatcher):  # with NUMBA_DISABLE_JIT it is the function itself
        compiled._cache = KernelCache(compiled)
    return compiled


class KernelCache(NullCache):
    """What numba asks when a kernel is needed for some types of arguments."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        self._enabled = True

    def enable(self) -> None:
        """Read and write from now on."""
        self._enabled = True

    def disable(self) -> None:
        """Neither read nor write from now on."""
        self._enabled = False

    @property
    def cache_path(self) -> str | None:
        """Folder of the entries; None where there is none."""
        return None if self._numba is None else self._numba.locator.get_cache_path()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what was compiled for a signature from the same definitions, or None."""
        if not self._enabled or self._numba is None:
            return None
        target_context.refresh()  # as numba does: it may not have been set up yet
        entry = self._entry(sig, target_context.codegen())
        data = None if entry is None else entry.read()
        return None if data is None else self._numba.rebuild(target_context, data)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled for a signature."""
        if not self._enabled or self._numba is None or not self._numba.check_cachable(data):
            return
        entry = self._entry(sig, data.codegen)
        if entry is not None:
            entry.write(self._numba.reduce(data))

    def flush(self) -> None:
        """Forget what is on disk."""
        if self._numba is not None:
            for path in Path(self.cache_path).glob(f'{self._name}-*{SUFFIX}'):
                path.unlink(missing_ok=True)

    @cached_property
    def _numba(self) -> CompileResultCacheImpl | None:
        """What knows where entries lie and how they are written; None where no place is found."""
        try:
            return CompileResultCacheImpl(self._dispatcher.py_func)
        except RuntimeError:
            say_once(
                'compiled code cannot be kept on this machine, so that every start takes a minute '
                'or two: set NUMBA_CACHE_DIR to a folder that can be written'
            )
            return None

    @cached_property
    def _stamp(self) -> str:
        return f'{VERSIONS} {digest_of(self._dispatcher)}'

    @property
    def _name(self) -> str:
        function = self._dispatcher.py_func
        place = f'{Path(function.__code__.co_filename).stem}.{function.__qualname__}'
        return place.replace('<', '').replace('>', '')

    def _entry(self, sig: Any, codegen: Any) -> Entry | None:
        """Return the file for a signature on this processor; None where types have no name."""
        arguments, _ = sigutils.normalize_signature(sig)
        described = _described(arguments)
        if ' at 0x' in described:  # an address, which is another one in the next process
            return None
        what = f'{described} {codegen.magic_tuple()} {sys.implementation.cache_tag}'
        short = hashlib.sha256(what.encode()).hexdigest()[:16]
        path = Path(self.cache_path, f'{self._name}-{short}{SUFFIX}')
        return Entry(path, f'{self._stamp} {what}')


class Entry:
    """One compiled function on disk, with a stamp that says what it was compiled from and for."""

    def __init__(self, path: Path, stamp: str) -> None:
        self.path, self.stamp = path, stamp

    def read(self) -> Any:
        """Return what was written under the same stamp; None: nothing, or it is damaged."""
        try:
            with self.path.open('rb') as file:
                return pickle.load(file) if pickle.load(file) == self.stamp else None
        except FileNotFoundError:
            return None
        except Exception as error:  # whatever a damaged pickle raises; what is right follows
            say_once(f'{self.path} is damaged ({error}), and compiled anew')
            return None

    def write(self, data: Any) -> None:
        """Replace the file at once; a disk that is full costs time at the next start alone."""
        partial_file = self.path.with_name(f'{self.path.name}.{os.getpid()}-{os.urandom(4).hex()}')
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            partial_file.write_bytes(pickle.dumps(self.stamp) + dumps(data))
            partial_file.replace(self.path)
        except OSError as error:
            say_once(f'compiled code cannot be kept in {self.path.parent} ({error.strerror})')
            partial_file.unlink(missing_ok=True)


def say_once(text: str) -> None:
    """Say something about this machine in one line, once in a process."""
    if text not in _said:
        _said.add(text)
        _log.warning(text)


def _described(arguments: Iterable[types.Type]) -> str:
    """
    Describe types of arguments so that those with another layout have another description.

    The names of a NamedTuple's fields say which number is meant, and numba's name of it leaves
    them out.
    """
    return ', '.join(map(_one_described, arguments))


def _one_described(argument: types.Type) -> str:
    made_of = getattr(argument, 'instance_class', None)
    if made_of is None and not isinstance(argument, types.BaseTuple):
        return repr(argument)
    inside = _described(argument.types)
    if made_of is None:
        return f'({inside})'
    return f'{made_of.__module__}.{made_of.__qualname__}{made_of._fields}({inside})'


def _adopt_plain_kernels() -> None:
    """
    Give this cache to kernels of the package that were declared by numba's own `njit(cache=True)`.

    Those of this package alone: other users of numba in the process keep numba's cache.
    """
    of_numba = Dispatcher.enable_caching

    def enable_caching(dispatcher: Dispatcher) -> None:
        if dispatcher.py_func.__module__.startswith('continuum_loc.'):
            dispatcher._cache = KernelCache(dispatcher)
        else:
            of_numba(dispatcher)

    Dispatcher.enable_caching = enable_caching
    for name, module in list(sys.modules.items()):
        if name.startswith('continuum_loc.'):
            for one in vars(module).values():
                if isinstance(one, Dispatcher) and not isinstance(one._cache, NullCache):
                    enable_caching(one)


_adopt_plain_kernels()
