"""
What results depend on, so that those of other code are not taken for this code's own.

Each digest is of the modules that the entries named here import (see `closure`). What writes
tables, figures and reports is not among them: a page that looks otherwise makes no trial run anew.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from continuum_loc.closure import digest_of_code

REPLAY = (
    'continuum_loc.mapping.map_files',
    'continuum_loc.offline.localise',
    'continuum_loc.offline.replay',
    'continuum_loc.offline.runs',
)
SIMULATION = ('continuum_loc.offline.trials',)


def replay_digest(*more: str) -> str:
    """
    Digest all that decides what a replay of a given bag in a given map gives.

    more: names of modules that have a part in it.
    """
    return digest_of_code(*REPLAY, *more)


def simulation_digest() -> str:
    """Digest all that decides what a simulated recording of a given trial holds."""
    return digest_of_code(*SIMULATION)


def content_digest(path: Path) -> str:
    """Digest a file, or all files in a folder, to the byte."""
    digest = hashlib.sha256()
    inside = sorted(each for each in path.rglob('*') if each.is_file())
    for each in inside if path.is_dir() else [path]:
        with each.open('rb') as stream:
            digest.update(hashlib.file_digest(stream, 'sha256').digest())
    return digest.hexdigest()
