"""ROS domains of one's own: two graphs on one machine would otherwise hear each other."""

from __future__ import annotations

import fcntl
from pathlib import Path
import tempfile
from typing import IO

from continuum_loc.errors import DomainError

DOMAINS = range(1, 102)  # beyond, their ports meet those that Linux hands out to anybody


class Domain:
    """
    A ROS_DOMAIN_ID that no other graph of this package has, on this machine, until `close`.

    Hand `lock` to a node's process (`pass_fds`): the domain then stays taken as long as that
    lives, even if whoever started it is gone.
    """

    def __init__(self) -> None:
        self.number, self._file = _taken()

    @property
    def lock(self) -> int:
        """Return the open file that holds the domain."""
        return self._file.fileno()

    def close(self) -> None:
        """Give the domain back."""
        self._file.close()

    def __enter__(self) -> Domain:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _taken() -> tuple[int, IO[str]]:
    for number in DOMAINS:
        file = _locked(Path(tempfile.gettempdir(), f'continuum_loc_domain_{number}.lock'))
        if file is not None:
            return number, file
    raise DomainError(f'all {len(DOMAINS)} ROS domains are taken by other graphs')


def _locked(path: Path) -> IO[str] | None:
    try:
        file = path.open('a')
    except PermissionError:  # another user's
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file
