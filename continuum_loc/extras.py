"""
What only some uses need: libraries by the extra of this package that brings them.

A node needs none of them. Whoever calls for one that is not installed is told what to type.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from continuum_loc.errors import NotInstalled

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


def not_installed(module: str, extra: str) -> NotInstalled:
    """Return the error for a module that is missing, with what to type."""
    return NotInstalled(
        f'{WHAT[extra]}, {module.partition(".")[0]} has to be installed: '
        f"pip install 'continuum_loc[{extra}]'"
    )


def explained(error: ModuleNotFoundError) -> NotInstalled | ModuleNotFoundError:
    """Return what to tell of an import that failed: what to type, where an extra brings it."""
    top = (error.name or '').partition('.')[0]
    extra = next((name for name, modules in EXTRAS.items() if top in modules), None)
    return error if extra is None else not_installed(top, extra)
