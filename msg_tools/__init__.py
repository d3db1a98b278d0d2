"""
ROS 2 messages and bags on one side, plain measurements on the other.

Nothing here needs a ROS installation.
"""

from importlib import import_module

_HOMES = {'BagWriter': 'bag', 'read_bag': 'bag'}
__all__ = list(_HOMES)


def __getattr__(name: str):
    """Load the bag reader only when somebody asks for it."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
