"""The continuous-time sliding-window filter. Start with `filter.py`."""

from __future__ import annotations

__all__ = [
    'Estimate',
    'EstimatorSettings',
    'SlidingWindowFilter',
    'load_estimator_settings',
    'settings_of',
    'smooth',
]


def __getattr__(name: str):
    if name == 'SlidingWindowFilter':
        from continuum_loc.estimator.filter import SlidingWindowFilter

        return SlidingWindowFilter
    if name == 'smooth':
        from continuum_loc.estimator.smoother import smooth

        return smooth
    if name == 'Estimate':
        from continuum_loc.estimator.estimate import Estimate

        return Estimate
    if name in ('EstimatorSettings', 'load_estimator_settings', 'settings_of'):
        from continuum_loc.estimator import settings

        return getattr(settings, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
