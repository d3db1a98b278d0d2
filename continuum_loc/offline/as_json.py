"""What is written as JSON: settings, results and versions as plain values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
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
