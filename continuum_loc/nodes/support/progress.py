"""What a node says while it compiles: how many kernels, for how long."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import time
from typing import Any

from numba.core.event import install_listener, Listener

EVERY = 5.0  # s between two words


class _Count(Listener):
    """Counts kernels as numba has compiled them; what is loaded is none."""

    def __init__(self, tell: Callable[[str], Any]) -> None:
        self.compiled, self._tell = 0, tell
        self.begin = self._told = time.monotonic()

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.begin

    def on_start(self, event: Any) -> None:
        """Nothing is said of it yet."""

    def on_end(self, event: Any) -> None:
        self.compiled += 1
        if time.monotonic() - self._told > EVERY:
            self._told = time.monotonic()
            self._tell(f'compiling: {self.compiled} kernels in {self.seconds:.0f} s')


@contextmanager
def compiling(tell: Callable[[str], Any]) -> Iterator[None]:
    """Say that kernels are compiled or loaded, every few seconds how far it is, and the end."""
    tell('compiling, or loading what an earlier run compiled')
    count = _Count(tell)
    with install_listener('numba:compile', count):
        yield
    what = f'compiled {count.compiled} kernels' if count.compiled else 'loaded all kernels'
    tell(f'{what} in {count.seconds:.1f} s')
