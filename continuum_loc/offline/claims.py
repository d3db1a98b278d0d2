"""Claims: figures beside the bounds that they have to keep, and the files that hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from importlib import metadata
import json
import math
from pathlib import Path
import platform
from typing import Any

import numpy as np
from pydantic import BaseModel

REPORTED_PACKAGES = (
    'continuum_loc',
    'numpy',
    'scipy',
    'numba',
    'mujoco',
    'pydantic',
    'pandas',
    'open3d',
    'rclpy',
)


@dataclass(frozen=True)
class Claim:
    """One figure that a study is meant to show, with the bound it has to keep."""

    name: str
    value: float
    unit: str
    bound: str
    holds: bool


# A value that is not a number holds no bound: every comparison below is false for nan.
def at_most(name: str, value: float, unit: str, limit: float) -> Claim:
    """Claim value <= limit."""
    return Claim(name, float(value), unit, f'<= {limit:g}', bool(value <= limit))


def at_least(name: str, value: float, unit: str, limit: float) -> Claim:
    """Claim value >= limit."""
    return Claim(name, float(value), unit, f'>= {limit:g}', bool(value >= limit))


def between(name: str, value: float, unit: str, low: float, high: float) -> Claim:
    """Claim low <= value <= high."""
    return Claim(name, float(value), unit, f'{low:g} to {high:g}', bool(low <= value <= high))


def write_study(
    out: Path,
    claims: Sequence[Claim],
    *,
    seed: int,
    settings: Any = None,
    tables: Mapping[str, Any] | None = None,
    extra: Mapping[str, Any] | None = None,
) -> Path:
    """
    Write `out/summary.json` and each table as CSV, JSON, Markdown and LaTeX.

    The summary holds claims, seed, versions and configuration.

    settings: the configuration of the study: pydantic settings, a dataclass or plain mappings of
    them.
    tables: by name, a pandas DataFrame or a list of rows (mappings).
    extra: further keys of the summary.
    Returns the path of the summary.
    """
    from continuum_loc.offline.tables import write_table

    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    for name, table in (tables or {}).items():
        write_table(table, out / name)
    summary = {
        'claims': list(claims),
        'seed': seed,
        'versions': versions(),
        'configuration': settings,
        'tables': sorted(tables or {}),
        **(extra or {}),
    }
    path = out / 'summary.json'
    write_json(path, summary)
    return path


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the packages that a result depends on."""
    found = {'python': platform.python_version(), 'platform': platform.platform()}
    for name in REPORTED_PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def write_json(path: Path, content: Any) -> None:
    """
    Write strict JSON.

    Arrays as lists, settings and dataclasses as mappings, not-finite numbers as null.
    """
    Path(path).write_text(json.dumps(plain(content), indent=2, allow_nan=False) + '\n')


def plain(value: Any) -> Any:
    """`value` as what strict JSON can hold. Raises TypeError for a type that has no such form."""
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode='json'))
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f'cannot write a {type(value).__name__} as JSON: {value!r}')
