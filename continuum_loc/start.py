"""
Where every command begins: nothing of ours is imported before it is known that it can be.

A node or a command without what it needs says so in one line, and one that is interrupted while it
still imports ends without a traceback.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
import sys

from continuum_loc.errors import NotInstalled
from continuum_loc.extras import explained, require_base

USAGE = 2
INTERRUPTED = 130  # as a shell has it: 128 + SIGINT


def begin(module: str) -> None:
    """Import a module and run its `main`, or say in one line what keeps it from that."""
    try:
        require_base()
        main = _main_of(module)
    except NotInstalled as error:
        sys.exit(_told(error))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    main()


def _main_of(module: str) -> Callable[[], None]:
    try:
        return import_module(module).main
    except ModuleNotFoundError as error:
        told = explained(error)
        if told is error:
            raise
        raise told from None


def _told(error: NotInstalled) -> int:
    print(f'error: {error}', file=sys.stderr)
    return USAGE


command_line = partial(begin, 'continuum_loc.cli')
simulator = partial(begin, 'continuum_loc.nodes.simulator')
estimator = partial(begin, 'continuum_loc.nodes.estimator')
shape = partial(begin, 'continuum_loc.nodes.shape')
recorder = partial(begin, 'continuum_loc.nodes.recorder')
replayer = partial(begin, 'continuum_loc.nodes.replayer')
driver = partial(begin, 'continuum_loc.nodes.driver')
viewer = partial(begin, 'continuum_loc.nodes.viewer')
