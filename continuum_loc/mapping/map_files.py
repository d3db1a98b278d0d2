"""Prior maps from files: our own, clouds, tables of text, and meshes."""

from __future__ import annotations

from dataclasses import replace
import json
from pathlib import Path
import warnings

from continuum_loc.errors import MapError
from continuum_loc.mapping.build import map_from_cloud, sample_mesh
from continuum_loc.mapping.prior_map import by_suffix, CLOUD_COLUMNS, NPZ_FORMAT, PriorMap
import numpy as np

COLUMN_COUNTS = (3, 6, 7)


def load_map(
    path: str | Path,
    *,
    sigma: float | None = None,
    spacing: float | None = None,
    viewpoint: np.ndarray | None = None,
    seed: int = 0,
) -> PriorMap:
    """
    Load a prior map from a file.

    `.npz`, `.ply`, `.pcd`, `.xyz`, `.csv`, or a mesh (`.stl`, `.obj`, `.ply` with faces).

    sigma: standard deviation of a point [m], where the file states none (default 0.1 mm, the
    paper's scanner).
    spacing: of the points sampled from a mesh [m] (default: about 300,000 points); seed: of that
    sampling.
    viewpoint: (3,) a place [m] that the surface is seen from, toward which the normals of a cloud
        that has none are turned. Without it they keep either sign and the map is not `oriented`.
    Raises MapError naming the file, the line and what is valid. Nothing is ever dropped.
    """
    path = Path(path)
    reader = by_suffix(path, _READERS, 'read')
    if not path.is_file():
        raise MapError(f'{path}: there is no such file')
    prior = reader(path, spacing, viewpoint, seed)
    return replace(prior, source=str(path), sigma=prior.sigma if sigma is None else sigma)


# Own format


def _read_npz(path: Path, spacing, viewpoint, seed) -> PriorMap:
    try:
        with np.load(path, allow_pickle=False) as data:
            if str(data['format']) != NPZ_FORMAT:
                raise MapError(f"{path}: format '{data['format']}', expected '{NPZ_FORMAT}'")
            return PriorMap(
                data['points'],
                data['normals'],
                data['planarity'],
                **json.loads(str(data['about'])),
            )
    except (KeyError, ValueError, OSError, TypeError) as error:
        if isinstance(error, MapError):
            raise
        raise MapError(f'{path}: not a map written by PriorMap.save ({error})') from None


# Tables of text


def _read_text(path: Path, spacing, viewpoint, seed) -> PriorMap:
    comma = path.suffix.lower() == '.csv'
    skipped = 0
    if comma:
        skipped = _check_csv_header(path)
    try:
        with warnings.catch_warnings(
            action='ignore', category=UserWarning
        ):  # of an empty file, which is refused below
            table = np.loadtxt(
                path, delimiter=',' if comma else None, skiprows=skipped, ndmin=2, comments='#'
            )
    except (ValueError, UnicodeDecodeError) as error:
        raise MapError(f'{path}: {_first_bad_line(path, skipped, comma) or error}') from None
    if table.size == 0:
        raise MapError(f'{path}: holds no points')
    if table.shape[1] not in COLUMN_COUNTS:
        raise MapError(f'{path}: {table.shape[1]} columns; valid are {_valid_columns()}')
    return _from_table(path, table, viewpoint)


def _valid_columns() -> str:
    return ' or '.join(','.join(CLOUD_COLUMNS[:count]) for count in COLUMN_COUNTS)


def _check_csv_header(path: Path) -> int:
    """
    Count header lines (0 or 1).

    A header must name the columns in order.
    """
    with path.open(errors='replace') as stream:
        names = [name.strip().lower() for name in stream.readline().split(',')]
    if tuple(names) in {CLOUD_COLUMNS[:count] for count in COLUMN_COUNTS}:
        return 1
    try:
        [float(name) for name in names]
    except ValueError:
        raise MapError(
            f'{path}, line 1: columns {",".join(names)}; valid are {_valid_columns()}'
        ) from None
    return 0


def _first_bad_line(path: Path, skipped: int, comma: bool) -> str | None:
    """
    Which line of a table cannot be used, and how many are like it.

    Only read after a failure.
    """
    width, first, count = None, None, 0
    with path.open(errors='replace') as stream:
        for number, line in enumerate(stream, start=1):
            fields = line.split('#')[0].strip()
            fields = fields.split(',') if comma and fields else fields.split()
            if number <= skipped or not fields:
                continue
            width = width or len(fields)
            if len(fields) == width and all(_is_number(field) for field in fields):
                continue
            count += 1
            first = first or f"line {number}: expected {width} numbers, got '{line.strip()[:80]}'"
    return first and f'{first} ({count} such lines)'


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _from_table(path: Path, table: np.ndarray, viewpoint) -> PriorMap:
    normals = table[:, 3:6] if table.shape[1] >= 6 else None
    planarity = table[:, 6] if table.shape[1] >= 7 else None
    return map_from_cloud(table[:, :3], normals, planarity, viewpoint=viewpoint, source=str(path))


# Clouds and meshes read by libraries


def _read_ply(path: Path, spacing, viewpoint, seed) -> PriorMap:
    with path.open('rb') as stream:
        header = stream.read(65536).split(b'end_header')[0].decode(errors='replace')
    faces = [line.split()[-1] for line in header.splitlines() if line.startswith('element face')]
    reader = _read_mesh if faces and faces[0] != '0' else _read_cloud
    return reader(path, spacing, viewpoint, seed)


def _read_cloud(path: Path, spacing, viewpoint, seed) -> PriorMap:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            cloud = open3d.t.io.read_point_cloud(
                str(path), remove_nan_points=False, remove_infinite_points=False
            )
        except RuntimeError as error:
            raise MapError(f'{path}: not a readable point cloud ({error})') from None
    if 'positions' not in cloud.point or len(cloud.point.positions) == 0:
        raise MapError(f'{path}: holds no points (or is not a valid {path.suffix} file)')
    fields = {
        name: cloud.point[name].numpy().astype(np.float64)
        for name in ('positions', 'normals', 'planarity')
        if name in cloud.point
    }
    planarity = fields['planarity'].ravel() if 'planarity' in fields else None
    return map_from_cloud(
        fields['positions'],
        fields.get('normals'),
        planarity,
        viewpoint=viewpoint,
        source=str(path),
    )


def _read_mesh(path: Path, spacing, viewpoint, seed) -> PriorMap:
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's parsers raise whatever they stumble on
        raise MapError(f'{path}: not a readable mesh ({error})') from None
    if len(getattr(mesh, 'faces', ())) == 0:
        raise MapError(f'{path}: holds no faces')
    chosen = {'count': 300_000} if spacing is None else {'spacing': spacing}
    return sample_mesh(mesh.vertices, mesh.faces, seed=seed, source=str(path), **chosen)


_READERS = {
    '.npz': _read_npz,
    '.ply': _read_ply,
    '.pcd': _read_cloud,
    '.xyz': _read_text,
    '.csv': _read_text,
    '.stl': _read_mesh,
    '.obj': _read_mesh,
}
