"""How far tips of statically loaded rods are from those of other solvers."""

from __future__ import annotations

import csv
from pathlib import Path

from continuum_loc.mechanics.statics import (
    equilibrium,
    Load,
    new_balance,
    no_load,
    no_tendons,
    Rod,
)
import numpy as np
from studies.support.cosserat import cosserat_shape

EI, GJ, LENGTH = 0.3, 0.25, 1.0
LOADS = 20  # drawn
# Published rods: radius [m], Young's modulus [Pa], Poisson's ratio, density [kg/m^3], length [m].
RODS = {
    'SpringSteelRodMuJoCo': (0.0008, 200e9, 0.33, 7870.0, 0.6),
    'TPURodMuJoCo': (0.005, 70e6, 0.4, 1200.0, 0.4),
}


def tip(rod: Rod, load: Load) -> np.ndarray:
    """Tip (3,) of a rod along x from the origin; nan where no equilibrium was found."""
    elements = len(rod.spans)
    balance, strain = new_balance(elements, 0), rod.rest.copy()
    balance.T[0] = np.eye(4)
    memory = np.zeros((elements, 2))
    if not equilibrium(rod, no_tendons(elements), load, memory, strain, balance):
        return np.full(3, np.nan)
    return balance.T[-1, :3, 3].copy()


def uniform(length: float, stiffness: np.ndarray, elements: int) -> Rod:
    """Rod of equal elements with stiffness (4,)."""
    return Rod(
        np.full(elements, length / elements),
        np.tile(stiffness, (elements, 1)),
        np.zeros((elements, 4)),
        np.zeros((elements, 2)),
    )


def cosserat_errors(elements: int, seed: int = 0) -> np.ndarray:
    """Find (LOADS,) errors [mm] under weight, tip forces and moments, against shooting."""
    rng, errors = np.random.default_rng(seed), []
    rod = uniform(LENGTH, np.array([np.inf, GJ, EI, EI]), elements)
    for _ in range(LOADS):
        force, moment = 0.3 * rng.normal(size=3), 0.15 * rng.normal(size=3)
        weight = rng.uniform(0.0, 0.6)
        wanted = cosserat_shape(np.array([LENGTH]), LENGTH, EI, GJ, np.inf, weight, force, moment)
        load = no_load(elements)
        load.force[-1], load.moment[-1], load.weight[2] = force, moment, -weight
        errors.append(1e3 * np.linalg.norm(tip(rod, load) - wanted[0, :3, 3]))
    return np.array(errors)


def sorosim_errors(folder: Path, elements: int) -> dict[str, np.ndarray]:
    """Errors [mm] of each published rod that is there, loaded at its middle and its tip."""
    found = {}
    for name, (radius, E, nu, density, length) in RODS.items():
        file = folder / f'{name}_dataStatics.csv'
        if not file.is_file():
            continue
        area, second = np.pi * radius**2, 0.25 * np.pi * radius**4
        stiffness = np.array([E * area, E * second / (1.0 + nu), E * second, E * second])
        rod = uniform(length, stiffness, elements)
        found[name] = np.array(
            [
                1e3
                * np.linalg.norm(tip(rod, _load(shape, density * area, elements)) - shape[3:, -1])
                for shape in _shapes(file)
            ]
        )
    return found


def _shapes(file: Path) -> np.ndarray:
    """(K, 6, 17): rows of moments and angles, then forces and places; columns as in the file."""
    rows = list(csv.reader(file.read_text().splitlines()))[2:]
    return np.array([[float(value) for value in row[1:]] for row in rows]).reshape(-1, 6, 17)


def _load(shape: np.ndarray, mass: float, elements: int) -> Load:
    """Gravity in column 0, wrenches at the middle in 1 and at the tip in 2."""
    load = no_load(elements)
    for node, column in ((elements // 2, 1), (elements, 2)):
        load.moment[node], load.force[node] = shape[:3, column], shape[3:, column]
    load.weight[:] = mass * shape[3:, 0]
    return load
