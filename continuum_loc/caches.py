"""Where what takes long to make is kept between runs, on a machine that lets us."""

from __future__ import annotations

from functools import cache
import os
from pathlib import Path
import tempfile


def cache_folder(kind: str) -> Path:
    """
    Name the folder of one kind of thing: `$XDG_CACHE_HOME/continuum_loc/KIND`.

    By default it is under `~/.cache`. It may not exist yet, or not be writable. Where there is no
    home it is in a folder of this process, which goes with it.
    """
    try:
        home = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache')
    except RuntimeError:  # a user that the system does not know, and no HOME
        return scratch_folder() / kind
    return home / 'continuum_loc' / kind


def scratch_folder() -> Path:
    """Return a folder of this process, which is removed at its end."""
    return Path(_scratch().name)


@cache
def _scratch() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix='continuum_loc-')
