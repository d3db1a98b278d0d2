"""The shape of a continuum robot from Hall sensors and IMUs (start with `estimator`)."""

from continuum_loc.shape.estimator import (
    load_shape_settings,
    ShapeEstimate,
    ShapeEstimator,
    ShapeSettings,
)

__all__ = ['ShapeEstimate', 'ShapeEstimator', 'ShapeSettings', 'load_shape_settings']
