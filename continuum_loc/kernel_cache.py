"""Compiled kernels that outlived their sources."""

from __future__ import annotations

from pathlib import Path


def forget_stale_kernels(package: Path) -> int:
    """
    Remove kernels under `package` that were compiled before its newest source; how many.

    Numba asks for the age of a kernel's own file alone, but a kernel holds those that it calls,
    whichever file they are from: after a change there, by `git pull` say, it would go on computing
    what they were. Raises ImportError where a stale kernel cannot be removed.
    """
    newest = max(_age(source) for source in package.rglob('*.py'))
    stale = [index for index in package.rglob('__pycache__/*.nbi') if _age(index) <= newest]
    for index in stale:
        try:
            index.unlink(missing_ok=True)  # another process may have been faster
        except OSError as error:
            raise ImportError(
                f'{index} was compiled before the newest source under {package} and cannot be '
                f'removed ({error.strerror}): remove it, or the results would be those of old code'
            ) from error
    return len(stale)


def _age(path: Path) -> int:
    """Time of the last change [ns]; 0 for a file that is gone."""
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return 0
