"""
Convex pieces of a closed mesh: by CoACD where it is small, else by plane cuts (`cutting`).

CoACD searches for few pieces, and takes minutes for some thousand faces. It has a process of its
own: on thin blades it can abort.

python -m continuum_loc.simulator.convex IN.npz OUT.npz    # what `convex_pieces` runs
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
import subprocess
import sys
import tempfile

from continuum_loc.errors import SceneError
from continuum_loc.extras import require
import numpy as np

SMALL = 2000  # faces that CoACD gets done within tens of seconds
_THRESHOLD = 0.02  # CoACD's concavity, as a share of the mesh's size
_FINEST, _FINENESS = 1e-3, 500.0  # tolerance of plane cuts: 1 mm, or a 500th of the longest edge
_SECONDS_PER_FACE = 4e-4  # of plane cuts, on a core of its own
_MODULE = 'continuum_loc.simulator.convex'

_log = logging.getLogger(__name__)


def convex_pieces(vertices: np.ndarray, faces: np.ndarray, where: str) -> tuple[np.ndarray, ...]:
    """Vertices (n, 3) of each convex piece of a closed mesh. Raises SceneError, naming `where`."""
    if len(faces) <= SMALL:
        pieces = _by_coacd(vertices, faces, where)
        if pieces:
            return pieces
    return _by_cuts(vertices, faces, where)


def tolerance(vertices: np.ndarray) -> float:
    """How far plane-cut pieces of a mesh may stand out of it [m]."""
    return max(_FINEST, float(np.ptp(vertices, axis=0).max()) / _FINENESS)


def _by_cuts(vertices: np.ndarray, faces: np.ndarray, where: str) -> tuple[np.ndarray, ...]:
    from continuum_loc.simulator import cutting
    from rich.console import Console
    from rich.progress import track

    allowed = tolerance(vertices)
    _log.warning(
        '%s: cutting %d faces into convex contact pieces, to %.1f mm: about %.0f s, once',
        where,
        len(faces),
        1e3 * allowed,
        max(1.0, _SECONDS_PER_FACE * len(faces)),
    )
    try:
        tiles = cutting.tiles(vertices, faces)
    except ValueError as error:
        raise SceneError(
            f'{where}: cannot be cut into convex pieces ({error}); mend the mesh where '
            'its surface meets itself'
        ) from None
    bar = track(tiles, 'contact pieces', console=Console(stderr=True), transient=True)
    return tuple(piece for tile in bar for piece in cutting.pieces(*tile, allowed))


def _by_coacd(vertices: np.ndarray, faces: np.ndarray, where: str) -> tuple[np.ndarray, ...]:
    """Pieces by CoACD, none (with a warning) where it fails."""
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, 'mesh.npz'), Path(folder, 'pieces.npz')
        np.savez(source, vertices=vertices, faces=faces)
        run = _run(_MODULE, source, result)
        if run.returncode == 0:
            with np.load(result) as pieces:
                return tuple(pieces[name] for name in pieces.files)
    last_words = (run.stderr.strip().splitlines() or [f'status {run.returncode}'])[-1]
    _log.warning('%s: CoACD failed (%s), cutting with planes instead', where, last_words)
    return ()


def _run(module: str, *arguments: object) -> subprocess.CompletedProcess:
    """Run a module of this package, also where it is not installed but on the caller's path."""
    search = os.pathsep.join(
        [str(Path(__file__).parents[2]), os.environ.get('PYTHONPATH', '')]
    ).rstrip(os.pathsep)
    return subprocess.run(
        [sys.executable, '-m', module, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {'PYTHONPATH': search},
    )


def _decompose(source: str, result: str) -> None:
    coacd = require('coacd', 'simulate')

    coacd.set_log_level('error')
    with np.load(source) as mesh:
        solid = coacd.Mesh(mesh['vertices'], mesh['faces'])
    pieces = coacd.run_coacd(solid, threshold=_THRESHOLD, preprocess_mode='auto', seed=0)
    np.savez(result, *[np.asarray(vertices, dtype=float) for vertices, _ in pieces])


if __name__ == '__main__':
    _decompose(*sys.argv[1:])
