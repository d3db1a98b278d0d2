"""Prior maps, their nearest-neighbour index, reconstruction of what the sensors saw, anomalies."""

import continuum_loc.compiling  # noqa: F401  # before a kernel here is declared by numba's `njit`
