"""What the readers give, and what they share: named columns become points and normals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from continuum_loc.errors import MapError
import numpy as np

FARTHEST = 1e9  # m: of a coordinate; squares and cubes of it can still be computed with
NORMAL = ('nx', 'ny', 'nz')
UNIT = 0.02  # how far the length of a normal may be from 1: two decimals, or one signed byte
# Other programs' names of ours; `points:0` and `normals:0` are ParaView's.
SYNONYMS = {
    **{f'points:{axis}': name for axis, name in enumerate('xyz')},
    **{f'normals:{axis}': name for axis, name in enumerate(NORMAL)},
    **{f'normal_{axis}': f'n{axis}' for axis in 'xyz'},
    **{f'normal{axis}': f'n{axis}' for axis in 'xyz'},
}
PADDING = '_'
USED = (*'xyz', *NORMAL, 'planarity')
MOST_AFTER = 4  # bytes of blanks and zeros that some writers add at the end of a file


@dataclass(frozen=True, eq=False)
class Cloud:
    """
    Points (P, 3) as the file has them, in its units.

    normals: (P, 3) of length 1 within UNIT, or None. planarity: (P,) or None. notes: what was left
    aside, in words.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    planarity: np.ndarray | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (V, 3) in the file's units, faces (F, 3) rows of them, and notes."""

    vertices: np.ndarray
    faces: np.ndarray
    notes: tuple[str, ...] = ()


def _counted(row: int) -> str:
    """Say how the rows of a file without lines are numbered."""
    return 'counted from 0'


def canonical(name: str) -> str:
    """Lower case, and our word for another program's."""
    return SYNONYMS.get(name.lower(), name.lower())


def doubled(names: Iterable[str]) -> list[str]:
    """Names that are there more than once."""
    return sorted(name for name, count in Counter(names).items() if count > 1)


def cloud_of(
    columns: dict[str, np.ndarray],
    where: str,
    *,
    place: Callable[[int], str] = _counted,
    incomplete: bool = False,
) -> Cloud:
    """
    Make a cloud of named columns (P,).

    place: says where a row is, in an error. incomplete: whether points without coordinates or
    normals (not finite) belong to the format; they are left out and counted, else they are an
    error.
    """
    require_columns(columns, where)
    points = np.column_stack([columns[name] for name in 'xyz']).astype(np.float64)
    normals, notes = None, []
    if NORMAL[0] in columns:
        normals = np.column_stack([columns[name] for name in NORMAL]).astype(np.float64)
    if incomplete:
        points, normals, columns, left_out = _complete(points, normals, columns)
        notes += left_out
    if len(points) == 0:
        raise MapError(f'{where}: holds no points')
    check_finite(points, 'points', where, place)
    check_near(points, where, place)
    if normals is not None:
        check_finite(normals, 'normals', where, place)
        normals, left_aside = usable_normals(normals, where, place)
        notes += left_aside
    planarity = columns.get('planarity')
    others = [name for name in columns if name not in USED and not name.startswith(PADDING)]
    if others:
        notes.append(f'left aside: {", ".join(others)}')
    return Cloud(
        points, normals, None if planarity is None else planarity.astype(np.float64), tuple(notes)
    )


def require_columns(names: Iterable[str], where: str) -> None:
    """Refuse a table without x, y and z, or with a part of a normal."""
    names = list(names)
    missing = [name for name in 'xyz' if name not in names]
    if missing:
        raise MapError(
            f'{where}: no {" and no ".join(missing)} among its fields '
            f'{", ".join(names) or "(none)"}'
        )
    given = [name for name in NORMAL if name in names]
    if given and len(given) < 3:
        raise MapError(
            f'{where}: {", ".join(given)} alone is no normal; valid are all of nx,ny,nz'
        )


def usable_normals(
    normals: np.ndarray, where: str, place: Callable[[int], str] = _counted
) -> tuple[np.ndarray | None, list[str]]:
    """
    Return the normals (P, 3) where all have length 1, or None and a note where none has.

    Raises MapError where some have and others do not.
    """
    with np.errstate(over='ignore'):
        length = np.linalg.norm(normals, axis=1)
    unit = np.abs(length - 1.0) <= UNIT
    if unit.all():
        return normals, []
    if not unit.any():
        return None, [
            'normals left aside: they do not have length 1 but '
            f'{length.min():.3g} to {length.max():.3g}'
        ]
    first = int(np.flatnonzero(~unit)[0])
    raise MapError(
        f'{where}: {int((~unit).sum())} of {len(unit)} normals do not have length 1, the first is '
        f'number {first} ({place(first)}), of length {length[first]:.3g}; mend them, or leave all '
        'normals out'
    )


def check_finite(
    rows: np.ndarray, name: str, where: str, place: Callable[[int], str] = _counted
) -> None:
    """Refuse rows (N, K) with a nan or an inf."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise MapError(
            f'{where}: {len(bad)} of {len(rows)} {name} are not finite, the first is '
            f'number {bad[0]} ({place(int(bad[0]))}); remove them or repair the file'
        )


def finite_rows(rows: np.ndarray, name: str, where: str) -> np.ndarray:
    """Return rows (N, 3), at least one, as float64 in one block. Raises MapError for others."""
    rows = np.ascontiguousarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) == 0:
        raise MapError(f'{where}: {name} must be (N, 3) with N >= 1, got {rows.shape}')
    check_finite(rows, name, where)
    return rows


def check_near(points: np.ndarray, where: str, place: Callable[[int], str] = _counted) -> None:
    """Refuse coordinates (N, 3) with which nothing can be computed."""
    far = np.flatnonzero(np.abs(points).max(axis=1, initial=0.0) > FARTHEST)
    if len(far):
        raise MapError(
            f'{where}: {len(far)} of {len(points)} points are more than {FARTHEST:g} from 0, the '
            f'first is number {far[0]} ({place(int(far[0]))})'
        )


def _complete(points, normals, columns):
    """Leave out what is not finite, as where a camera saw nothing."""
    placed = np.isfinite(points).all(axis=1)
    notes = _left_out(placed, 'coordinates')
    kept = placed
    if normals is not None:
        kept = placed & np.isfinite(normals).all(axis=1)
        if placed.any() and not kept.any():
            normals, kept = None, placed
            notes.append('normals left aside: none is finite')
        else:
            notes += _left_out(~placed | kept, 'normal')
    if kept.all():
        return points, normals, columns, notes
    rest = {name: values[kept] for name, values in columns.items()}
    return points[kept], None if normals is None else normals[kept], rest, notes


def _left_out(complete: np.ndarray, what: str) -> list[str]:
    count = int((~complete).sum())
    return [f'{count} of {len(complete)} points left out: they have no {what}'] if count else []


def mesh_of(vertices: np.ndarray, faces: np.ndarray, notes: list[str], where: str) -> Mesh:
    """Make a mesh of vertices (V, 3) that are finite and faces (F, 3) that name them."""
    vertices = vertices.astype(np.float64)
    check_finite(vertices, 'vertices', where)
    check_near(vertices, where)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise MapError(
            f'{where}: its faces name vertices {faces.min()} to {faces.max()} (counted from 0), '
            f'there are {len(vertices)}'
        )
    return Mesh(vertices, faces, tuple(notes))


def triangles_of(sizes: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """
    Cut polygons into triangles (F, 3), as fans from each one's first corner.

    sizes: (N,) corners of each, at least 3. corners: all of them, one polygon after the other.
    """
    first = np.cumsum(sizes) - sizes
    fans = sizes - 2
    start = np.repeat(first, fans)
    step = np.arange(int(fans.sum())) - np.repeat(np.cumsum(fans) - fans, fans)
    faces = np.stack(
        [corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1
    )
    many = int((sizes > 3).sum())
    return faces, [f'{many} polygons cut into triangles'] if many else []


def check_rest(after: bytes, where: str) -> None:
    """Refuse what comes after all that a header promised."""
    if len(after) > MOST_AFTER or after.strip(b'\r\n\t \0'):
        raise MapError(
            f'{where}: goes on for {len(after)} bytes after what its header says: a count or a '
            'type in it is wrong'
        )
