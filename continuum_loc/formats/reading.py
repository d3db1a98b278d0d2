"""The reader that a file's name asks for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from continuum_loc.errors import MapError
from continuum_loc.formats.content import bytes_of
from continuum_loc.formats.obj import read_obj
from continuum_loc.formats.pcd import read_pcd
from continuum_loc.formats.ply import read_ply
from continuum_loc.formats.shapes import Cloud, Mesh
from continuum_loc.formats.stl import read_stl
from continuum_loc.formats.text import read_pts, read_text


def read_shape(path: Path) -> Cloud | Mesh:
    """
    Read a cloud or a mesh as the file has it, in its units.

    Raises MapError naming the file, the place and what is valid.
    """
    suffixes = [suffix.lower() for suffix in path.suffixes]
    suffix = suffixes[-1] if suffixes else ''
    if suffix == '.gz':
        suffix = suffixes[-2] if len(suffixes) > 1 else ''
    if suffix not in READERS:
        raise MapError(
            f"{path}: a map cannot be read as '{suffix}'; valid are .npz, {', '.join(READERS)}"
        )
    try:
        return READERS[suffix](bytes_of(path), str(path))
    except MemoryError:
        raise MapError(f'{path}: does not fit into memory') from None


READERS: dict[str, Callable[[bytes, str], Cloud | Mesh]] = {
    '.ply': read_ply,
    '.pcd': read_pcd,
    '.xyz': read_text,
    '.txt': read_text,
    '.asc': read_text,
    '.csv': read_text,
    '.pts': read_pts,
    '.stl': read_stl,
    '.obj': read_obj,
}
