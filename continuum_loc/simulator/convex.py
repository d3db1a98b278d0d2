"""
Convex pieces of a closed mesh, by CoACD, in a process of its own: on thin blades CoACD can abort.

python -m continuum_loc.simulator.convex IN.npz OUT.npz MODE    # what `convex_pieces` runs
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
import subprocess
import sys
import tempfile

from continuum_loc.simulator.scene import SceneError
import numpy as np

# Preprocessing: only if the mesh needs it; or always, by a coarse remeshing that never fails.
_MODES = (
    'auto',
    'on',
)
_THRESHOLD = {'auto': 0.02, 'on': 0.05}  # concavity, as a share of the mesh's size
_REMESHING = 100  # cells along the longest edge
_MODULE = 'continuum_loc.simulator.convex'

_log = logging.getLogger(__name__)


def convex_pieces(vertices: np.ndarray, faces: np.ndarray, where: str) -> tuple[np.ndarray, ...]:
    """
    Vertices (n, 3) of each convex piece of a closed mesh.

    Raises SceneError, naming `where`, if CoACD fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, result = Path(folder, 'mesh.npz'), Path(folder, 'pieces.npz')
        np.savez(source, vertices=vertices, faces=faces)
        for mode in _MODES:
            run = _run(_MODULE, source, result, mode)
            if run.returncode == 0:
                with np.load(result) as pieces:
                    return tuple(pieces[name] for name in pieces.files)
            if mode != _MODES[-1]:
                _log.warning(
                    '%s: convex decomposition failed, trying again with a remeshed surface: '
                    'contact will be coarse, to about %.0f mm',
                    where,
                    1e3 * np.ptp(vertices, axis=0).max() / _REMESHING,
                )
    last_words = (run.stderr.strip().splitlines() or [f'status {run.returncode}'])[-1]
    raise SceneError(
        f'{where}: cannot be split into convex pieces for contact (CoACD: {last_words}); '
        'simplify the mesh, or thicken its thinnest walls'
    )


def _run(module: str, *arguments: object) -> subprocess.CompletedProcess:
    """
    Run a module of this package.

    Also where the package is not installed but on the caller's path.
    """
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


def _decompose(source: str, result: str, mode: str) -> None:
    import coacd

    coacd.set_log_level('error')
    with np.load(source) as mesh:
        solid = coacd.Mesh(mesh['vertices'], mesh['faces'])
    pieces = coacd.run_coacd(
        solid,
        threshold=_THRESHOLD[mode],
        preprocess_mode=mode,
        preprocess_resolution=_REMESHING,
        seed=0,
    )
    np.savez(result, *[np.asarray(vertices, dtype=float) for vertices, _ in pieces])


if __name__ == '__main__':
    _decompose(*sys.argv[1:])
