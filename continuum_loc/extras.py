"""
What has to be installed beside this package, and what to type where it is not.

A base that everything needs; libraries that only some uses need, by the extra that brings them.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module, metadata
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
import re
import sys
import sysconfig
from types import ModuleType

from continuum_loc.errors import NotInstalled

# What everything needs, by the name of the distribution: the oldest version that was tried, as
# setup.py has it. `make test-noble` tries them.
BASE = {
    'numpy': '1.26.4',
    'scipy': '1.11.4',
    'numba': '0.58.1',
    'threadpoolctl': '3.1.0',
    'pydantic': '2.4.2',
    'pyyaml': '6.0.1',
    'rosbags': '0.11.7',
    'typer': '0.12.5',
    'rich': '13.7.1',
}
# Modules by extra, as setup.py has them. One that is in several belongs to the first, where it is
# not said what it was wanted for.
EXTRAS = {
    'simulate': ('mujoco', 'manifold3d', 'coacd', 'open3d', 'trimesh'),
    'report': ('plotly', 'jinja2', 'pandas', 'PIL'),
    'studies': ('matplotlib', 'psutil'),
    'cluster': ('distributed',),
    'ros': ('rclpy',),
}
WHAT = {
    'simulate': 'to simulate and to draw scenes',
    'report': 'to write reports and tables',
    'studies': 'to run studies',
    'cluster': 'to run on a cluster',
    'ros': 'to run nodes without a ROS installation',
}
# What pip calls a module where it has another name.
DISTRIBUTIONS = {
    'PIL': 'pillow',
    'rclpy': "'ros-jazzy-rclpy[fastrtps]==7.1.6' ros-common-interfaces==5.3.6",
}
# What pip needs first where the system's Python is the distribution's own (PEP 668).
ENVIRONMENT = 'python3 -m venv --system-site-packages .venv && . .venv/bin/activate && '


def require(module: str, extra: str) -> ModuleType:
    """
    Import a module that an extra brings.

    Raises NotInstalled, which says what to type, where it is not there.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition('.')[0]:
            raise
        raise not_installed(module, extra) from None


def require_all(extra: str) -> None:
    """Raise NotInstalled unless everything that an extra brings is there."""
    for module in EXTRAS[extra]:
        if find_spec(module) is None:
            raise not_installed(module, extra)


def require_base(needed: Mapping[str, str] = BASE) -> None:
    """
    Raise NotInstalled where something that everything needs is missing or too old.

    Asks what is installed, and imports nothing: pydantic 1 fails in the middle of an import, typer
    0.9 at the first command.
    """
    lacking = {name: found for name in needed if (found := _lacks(name, needed[name])) is not None}
    if lacking:
        said = ', '.join(
            f'{name} {needed[name]} or newer ({found})' for name, found in lacking.items()
        )
        wanted = ' '.join(f"'{name}>={needed[name]}'" for name in lacking)
        raise NotInstalled(
            f'continuum_loc needs {said}; type: {_environment()}pip install {wanted}'
        )


def not_installed(module: str, extra: str) -> NotInstalled:
    """Return the error for a module that is missing, with what to type."""
    wanted = ' '.join(DISTRIBUTIONS.get(one, one) for one in EXTRAS[extra])
    return NotInstalled(
        f'{WHAT[extra]}, {module.partition(".")[0]} has to be installed: '
        f'{_environment()}pip install {wanted}'
    )


def explained(error: ModuleNotFoundError) -> NotInstalled | ModuleNotFoundError:
    """Return what to tell of an import that failed: what to type, where an extra brings it."""
    top = (error.name or '').partition('.')[0]
    extra = next((name for name, modules in EXTRAS.items() if top in modules), None)
    return error if extra is None else not_installed(top, extra)


def _lacks(name: str, least: str) -> str | None:
    """Say what is installed of a distribution, or None where that is new enough."""
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        return 'not installed'
    return None if _numbers(found) >= _numbers(least) else f'{found} is installed'


def _numbers(version: str) -> tuple[int, ...]:
    """Read the numbers of a version before anything else: (1, 26) of 1.26rc1."""
    parts = (re.match(r'\d+', part) for part in version.split('.'))
    return tuple(int(part[0]) for part in takewhile(bool, parts))


def _environment() -> str:
    """Return what to type before pip, where it refuses to install beside the system's packages."""
    managed = Path(sysconfig.get_path('stdlib'), 'EXTERNALLY-MANAGED').is_file()
    return ENVIRONMENT if managed and sys.prefix == sys.base_prefix else ''
