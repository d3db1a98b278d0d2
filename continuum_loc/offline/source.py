"""
Digests of this package's own source, so that results of other code are not taken for its own.

A digest is of what the code says: comments, docstrings and layout do not change it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from fnmatch import fnmatchcase
from functools import cache
import hashlib
from pathlib import Path

import continuum_loc
import msg_tools

PACKAGES = (Path(continuum_loc.__file__).parent, Path(msg_tools.__file__).parent)
# What no replay and no simulation runs. Everything else counts: a module that is missing here
# costs time; one missing from a list of what counts would let old results pass.
NEITHER = (
    'cli.py',
    'nodes/*',
    'shape/*',
    'evaluation/studies/*',
    'evaluation/templates/*',
    'evaluation/bags.py',
    'evaluation/bench.py',
    'evaluation/campaign.py',
    'evaluation/demo.py',
    'evaluation/error_tables.py',
    'evaluation/figures.py',
    'evaluation/footprint.py',
    'evaluation/pictures.py',
    'evaluation/report.py',
    'evaluation/shape_replay.py',
    'evaluation/source.py',
    'evaluation/split.py',
    'evaluation/study_report.py',
    'evaluation/tables.py',
    'evaluation/tune.py',
    'evaluation/view.py',
    'mapping/anomalies.py',
    'mapping/free_space.py',
    'mapping/fuse.py',
    'mapping/reconstruct.py',
    'mapping/splat_cast.py',
)
# Of the rest, what a recording does not depend on, and what a replay does not.
NOT_SIMULATED = (
    'estimator/*',
    'mapping/*',
    'evaluation/metrics.py',
    'evaluation/replay.py',
    'evaluation/runs.py',
    'evaluation/study.py',
    'evaluation/tracks.py',
)
NOT_REPLAYED = ('simulator/*',)


@cache
def replay_digest() -> str:
    """Digest all that decides what a replay of a given bag in a given map gives."""
    return digest_of(files(NEITHER + NOT_REPLAYED))


@cache
def simulation_digest() -> str:
    """Digest all that decides what a simulated recording of a given trial holds."""
    return digest_of(files(NEITHER + NOT_SIMULATED))


def files(without: tuple[str, ...]) -> list[Path]:
    """List the source and the presets of this package but for those of some patterns."""
    return [
        path
        for package in PACKAGES
        for suffix in ('py', 'yaml')
        for path in sorted(package.rglob(f'*.{suffix}'))
        if not _named(path.relative_to(package), without)
    ]


def _named(path: Path, patterns: tuple[str, ...]) -> bool:
    return any(fnmatchcase(path.as_posix(), pattern) for pattern in patterns)


def digest_of(files: Iterable[Path]) -> str:
    """Digest what Python files say, and other files to the byte."""
    digest = hashlib.sha256()
    for path in files:
        content = path.read_bytes()
        said = _said(content) if path.suffix == '.py' else content
        digest.update(f'{path.name} {len(said)} '.encode() + said)
    return digest.hexdigest()[:16]


def _said(source: bytes) -> bytes:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        documented = isinstance(
            node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        )
        if documented and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree).encode()
