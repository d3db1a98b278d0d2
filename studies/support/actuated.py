"""Robots with tendons that studies identify or drive: descriptions with and without a block."""

from __future__ import annotations

from continuum_loc.actuation import Actuation
from continuum_loc.plausible import GRAVITY
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.simulator.plant import load_plant

# Where the modules of the real robots end [m], as their makers say; the base looks along +z.
REAL = {'v4': (0.060, 0.1225, 0.1865), 'v6': (0.100, 0.200, 0.222)}
ARM, RADIUS = 0.0045, 0.0065  # [m]
# How far the statics of a simulated robot are off in free space: stretch, bending [1/m].
SIGMA = {'engine': (0.002, 0.05, 0.05), 'soft_arm': (0.01, 0.1, 0.1)}
WRONG_STIFFNESS, WRONG_WEIGHT, WRONG_ANGLE = 1.05, 0.97, 2.0  # share, share, degrees


def real_robot(name: str) -> RobotDescription:
    """Describe a real robot without what is to be found of it."""
    ends = REAL[name]
    return RobotDescription(
        name=name,
        length=ends[-1],
        radius=RADIUS,
        base={'rpy_deg': (0.0, -90.0, 0.0)},
        backbone={'module_ends': ends[:-1]},
        rings=[{'name': 'tip', 's': ends[-1]}],
        trackers=[{'name': 'marker', 'ring': 'tip'}],
    )


def simulated_robot(name: str, wrong: bool = False) -> RobotDescription:
    """Give a bundled robot the block of its plant, with tensions; or one a little wrong."""
    plant, robot = load_plant(name), load_robot(name)
    stiff, heavy, turned = (
        (WRONG_STIFFNESS, WRONG_WEIGHT, WRONG_ANGLE) if wrong else (1.0, 1.0, 0.0)
    )
    names = iter(plant.tendon_names)
    tendons = [
        {
            'name': next(names),
            'end': group.end,
            'azimuth_deg': azimuth + turned,
            'radius': group.radius,
        }
        for group in plant.tendons
        for azimuth in group.azimuth_deg
    ]
    block = Actuation(
        mode='tension',
        tendons=tendons,
        EI=(stiff * plant.EI,),
        GJ=stiff * plant.GJ,
        EA=plant.EA,
        weight=(0.0, 0.0, -heavy * GRAVITY * plant.mass_per_metre),
        delay=plant.relaxation,  # a viscous body follows its moments by its time constant
        strain_sigma=SIGMA[name],
    )
    return robot.model_copy(update={'actuation': block})
