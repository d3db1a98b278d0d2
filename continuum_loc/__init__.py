"""Online estimation of continuum robots: `estimator.filter` is where to start reading."""
