"""The studies behind the figures that the README quotes: one module each, see `continuum_loc.evaluation.study`."""
