"""Online estimation of continuum robots: `estimator.filter` is where to start reading."""

from pathlib import Path

from continuum_loc.kernel_cache import forget_stale_kernels

forget_stale_kernels(Path(__file__).parent)
