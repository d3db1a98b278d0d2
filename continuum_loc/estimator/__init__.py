"""The continuous-time sliding-window filter. Start with `filter.py`."""

from importlib import import_module

_HOMES = {
    'EstimatorSettings': 'settings',
    'SlidingWindowFilter': 'filter',
    'load_estimator_settings': 'settings',
    'settings_of': 'settings',
    'smooth': 'smoother',
}
__all__ = list(_HOMES)


def __getattr__(name: str):
    """Load a module only when somebody asks for what it holds."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
