"""
The simulated robot in its scene.

`World` drives it and yields what its sensors measure, with the truth.
"""

from continuum_loc.errors import SimulationDiverged
from continuum_loc.simulator.world import World

__all__ = ['SimulationDiverged', 'World']
