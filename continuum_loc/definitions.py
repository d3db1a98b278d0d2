"""
What a compiled function is made of: a digest of its definition and of all that it refers to.

It goes by names from a function's code to the functions, constants and classes that the code
names, in whichever module they stand, and from those to theirs. Comments, docstrings, layout and
the place in a file do not change it, and nor does anything that is not referred to.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from functools import cache
import hashlib
import sysconfig
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

_LIBRARIES = tuple({sysconfig.get_path(name) for name in ('stdlib', 'purelib', 'platlib')})
_SIMPLE = (type(None), type(Ellipsis), bool, int, float, complex, str, bytes)


def digest_of(function: Any) -> str:
    """
    Digest a function, compiled or plain, with everything that it refers to.

    Raises TypeError where it refers to something that cannot be told from another of its kind.
    """
    found: dict[FunctionType, str] = {}
    waiting = [_function(function)]
    while waiting:
        one = waiting.pop()
        if one not in found:
            parts = _parts(one)
            found[one] = parts.digest
            waiting += parts.functions
    return _hashed(repr((_options(function), sorted(found.values()))))


class _Parts:
    """One function: a digest of what is its own, and the functions that it refers to."""

    def __init__(self, function: FunctionType) -> None:
        self.home = function.__module__.partition('.')[0]
        self.functions: list[FunctionType] = []
        code = function.__code__
        said = [function.__module__, function.__qualname__, _code_of(code, function.__doc__)]
        said += [self._value(value) for value in (function.__defaults__, function.__kwdefaults__)]
        names = sorted(set(_names(code)))
        said += [
            f'{name} is {self._value(function.__globals__[name], names)}'
            for name in names
            if name in function.__globals__
        ]
        said += [self._value(cell.cell_contents) for cell in function.__closure__ or ()]
        self.digest = _hashed('\n'.join(said))

    def _value(self, value: Any, names: list[str] = ()) -> str:
        """Describe what a name stands for; `names`: what may be asked of it."""
        if isinstance(value, _SIMPLE):
            return repr(value)
        if isinstance(value, (np.ndarray, np.generic)):
            array = np.asarray(value)
            return f'array {array.dtype} {array.shape} {_hashed(array.tobytes())}'
        if isinstance(value, (tuple, list)):
            inside = ', '.join(self._value(one, names) for one in value)
            return f'{type(value).__name__}({inside})'
        if isinstance(value, (set, frozenset)):
            return f'set{sorted(self._value(one) for one in value)}'
        if isinstance(value, dict):
            return f'dict{[(self._value(k), self._value(v)) for k, v in value.items()]}'
        if isinstance(value, ModuleType):
            return self._module(value, names)
        if isinstance(value, type):
            return self._class(value)
        return self._other(value)

    def _module(self, module: ModuleType, names: list[str]) -> str:
        if not self._ours(module):
            return module.__name__
        asked = {name: vars(module)[name] for name in names if name in vars(module)}
        return f'{module.__name__} {self._value(asked)}'

    def _class(self, kind: type) -> str:
        said = f'{kind.__module__}.{kind.__qualname__}'
        if issubclass(kind, Enum):
            return f'{said} {[(one.name, self._value(one.value)) for one in kind]}'
        if hasattr(kind, '_fields'):  # a NamedTuple
            defaults = self._value(getattr(kind, '_field_defaults', {}))
            return f'{said} {kind._fields} {defaults}'
        if kind.__module__.partition('.')[0] == self.home:
            self.functions += [one for one in vars(kind).values() if isinstance(one, FunctionType)]
        return said

    def _other(self, value: Any) -> str:
        function = _function(value)
        if isinstance(function, FunctionType):
            name = f'{function.__module__}.{function.__qualname__}'
            if function is not value or self._ours(function):
                self.functions.append(function)
            return f'{name} {_options(value)}'
        if isinstance(function, BuiltinFunctionType) or hasattr(function, '__qualname__'):
            return f'{function.__module__}.{function.__qualname__}'
        said = repr(value)
        if ' at 0x' in said:
            raise TypeError(
                f'a compiled function refers to {said}, which nothing tells from another '
                f'{type(value).__name__}: name a number, an array, a tuple or a function instead'
            )
        return f'{type(value).__module__}.{type(value).__qualname__} {said}'

    def _ours(self, thing: Any) -> bool:
        """Whether it may change without a new version of anything: not of a library."""
        name = thing.__name__ if isinstance(thing, ModuleType) else thing.__module__
        if name.partition('.')[0] == self.home:
            return True
        where = getattr(thing, '__file__', None) or (
            thing.__code__.co_filename if isinstance(thing, FunctionType) else ''
        )
        return bool(where) and not str(where).startswith((*_LIBRARIES, '<'))


@cache
def _parts(function: FunctionType) -> _Parts:
    return _Parts(function)


def _options(dispatcher: Any) -> str:
    """Options of a compilation, such as `inline`; nothing for a plain function."""
    return repr(sorted(getattr(dispatcher, 'targetoptions', {}).items()))


def _function(value: Any) -> Any:
    """Return what a dispatcher of numba compiles, or an intrinsic is defined by; else `value`."""
    for name in ('py_func', '_defn'):
        inside = getattr(value, name, None)
        if isinstance(inside, FunctionType):
            return inside
    return value


def _names(code: CodeType) -> Iterator[str]:
    """Yield what code and the functions in it name: globals, and attributes of the same names."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code_of(code: CodeType, documentation: str | None) -> str:
    """Describe code without its docstring and without the lines that it stands on."""
    constants = list(code.co_consts)
    if documentation is not None and constants and constants[0] == documentation:
        constants[0] = None
    said = [
        _code_of(one, one.co_consts[0] if _documented(one) else None)
        if isinstance(one, CodeType)
        else repr(sorted(map(repr, one)) if isinstance(one, frozenset) else one)
        for one in constants
    ]
    return repr(
        (
            code.co_code,
            getattr(code, 'co_exceptiontable', b''),
            said,
            code.co_names,
            code.co_varnames,
            code.co_freevars,
            code.co_cellvars,
            code.co_flags,
        )
    )


def _documented(code: CodeType) -> bool:
    """Whether the first constant of a function in a function is its docstring."""
    return bool(code.co_consts) and isinstance(code.co_consts[0], str)


def _hashed(said: str | bytes) -> str:
    return hashlib.sha256(said.encode() if isinstance(said, str) else said).hexdigest()
