"""The simulated robot in its scene: `World` yields what its sensors measure, and the truth."""

from importlib import import_module

_HOMES = {'World': 'world'}
__all__ = list(_HOMES)


def __getattr__(name: str):
    """Load a module only when somebody asks for what it holds."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
