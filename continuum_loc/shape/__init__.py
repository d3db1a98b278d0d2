"""The shape of a continuum robot from Hall sensors and IMUs (start with `estimator`)."""

from continuum_loc.shape.estimate import ShapeEstimate
from continuum_loc.shape.estimator import ShapeEstimator
from continuum_loc.shape.settings import load_shape_settings, ShapeSettings

__all__ = ['ShapeEstimate', 'ShapeEstimator', 'ShapeSettings', 'load_shape_settings']
