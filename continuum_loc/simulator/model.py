"""
The robot as a MuJoCo model: rigid links on ball joints, tendons, an insertion drive, contacts.

Nodes at s_0 = 0 ... s_N = L. Body i is rigid and centred on node i; it reaches half a segment to
each side, and neighbours meet in a joint in the middle of their segment. So node i is the middle
of its link, the joint spring EI / h is the segment's bending stiffness exactly, and the two half
links at the ends are clamped and
free as they should be: second-order accurate in h.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from continuum_loc.errors import SettingsError, SimulationDiverged
from continuum_loc.extras import require
from continuum_loc.robot import Ring, RobotDescription
from continuum_loc.simulator.carrier import Carrier, JOINTS, pose_of
from continuum_loc.simulator.plant import node_arclengths, PlantSettings, Profile
import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    import mujoco

GRAVITY = 9.81
SCALAR_LAST = np.array([1, 2, 3, 0])  # MuJoCo's w comes first, scipy's last
ROBOT_BIT, SCENE_BIT = 1, 2  # collision masks: links meet the scene, never one another
NODE_PREFIX = 'node'
REST_SPEED = 1e-4
SETTLE_LIMIT = 60.0  # s of simulated time
# Damping while settling, relative to the plant's: near critical for the first mode.
SETTLE_DAMPING = 8.0
QUIET_STEPS = 20
# Near-hard: MuJoCo's default friction creeps, and forgets a hysteresis.
STICTION = (
    0.999,
    0.999,
    0.001,
    0.5,
    2.0,
)
LEAST_INERTIA = 1e-15  # kg and kg m^2: MuJoCo's least
DIVERGED_SPEED = 1e3  # rad/s or m/s
GUIDE = 0.25  # share of a segment that tendons cross unguided, in its middle


def build_spec(
    robot: RobotDescription,
    plant: PlantSettings,
    scene=None,
    profile: str = 'live',
    supported: bool = False,
    carried: Carrier | None = None,
) -> mujoco.MjSpec:
    """
    Build the model before compilation.

    scene: gives the convex pieces to collide with; None is empty space. supported: something else
    carries the rod's weight. carried: what moves the base.
    """
    mujoco = require('mujoco', 'simulate')

    chosen = plant.profile(profile)
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.option.timestep = chosen.time_step
    spec.option.gravity = (0.0, 0.0, 0.0 if supported else -GRAVITY)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.solver = mujoco.mjtSolver.mjSOL_CG
    # Divergence is ours to report.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.autolimits = True
    if plant.GJ != plant.EI:
        spec.nuser_jnt = 1
    nodes = node_arclengths(robot, plant, chosen.link_length)
    if robot.base.insertion.mode != 'fixed' or carried is not None:
        _check_step(plant, chosen.time_step)
    _add_rod(spec, robot, plant, nodes, carried)
    _add_tendons(spec, plant, nodes)
    if scene is not None:
        _add_scene(spec, robot, plant, scene, carried)
    return spec


def build_model(
    robot: RobotDescription,
    plant: PlantSettings,
    scene=None,
    profile: str = 'live',
    supported: bool = False,
    carried: Carrier | None = None,
) -> mujoco.MjModel:
    """Compile `build_spec`; bodies `node0` ... `nodeN` are the links. Raises SettingsError."""
    spec = build_spec(robot, plant, scene, profile, supported, carried)
    try:
        return spec.compile()
    except ValueError as error:
        raise SettingsError(
            f"no model can be made of robot '{robot.name}' with this plant and scene: "
            f'{" ".join(str(error).split())}'
        ) from None


def advance(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """One step. Raises SimulationDiverged, with the joint and what to change."""
    import mujoco

    if model.nuser_jnt:
        _add_twist_torque(model, data)
    mujoco.mj_step(model, data)
    speed = np.abs(data.qvel)
    if np.isfinite(data.qacc).all() and speed.max(initial=0.0) < DIVERGED_SPEED:
        return
    worst = int(np.argmax(np.where(np.isfinite(data.qacc), speed, np.inf)))
    joint = model.joint(int(model.dof_jntid[worst])).name
    raise SimulationDiverged(
        f"the simulation diverged at {data.time:.4f} s in joint '{joint}' "
        f'({speed[worst]:.3g} rad/s or m/s): shorten `time_step` (now {model.opt.timestep} s) '
        'or raise `relaxation` in the plant, or lower the forces there'
    )


def _add_twist_torque(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """
    Make up for what a ball joint's spring, with one stiffness for all axes, has too much of twist.

    With w the joint's rotation vector and c = (EI - GJ) / h, the energy -c w_x^2 / 2 to be added
    gives the torque c w_x (1, -w_z / 2, w_y / 2) in the link's frame, to second order in w.
    """
    excess = model.jnt_user[:, 0]
    joints = np.flatnonzero(excess)
    quat = data.qpos[model.jnt_qposadr[joints, None] + SCALAR_LAST]
    w = Rotation.from_quat(quat).as_rotvec()
    lever = np.stack([np.ones(len(joints)), -w[:, 2] / 2.0, w[:, 1] / 2.0], axis=1)
    torque = (excess[joints] * w[:, 0])[:, None] * lever
    data.qfrc_applied[model.jnt_dofadr[joints, None] + np.arange(3)] = torque


def settle(model: mujoco.MjModel, data: mujoco.MjData, rest_speed: float = REST_SPEED) -> None:
    """
    Bring the model to rest under its present controls and applied forces; velocities end at zero.

    rest_speed: what every link has to be slower than, m/s and rad/s. Raises SimulationDiverged.
    """
    damping = model.dof_damping.copy()
    model.dof_damping[:] = SETTLE_DAMPING * damping
    try:
        quiet = 0
        while quiet < QUIET_STEPS:
            if data.time > SETTLE_LIMIT:
                raise SimulationDiverged(
                    f'the robot did not come to rest within {SETTLE_LIMIT} s under its first '
                    'tensions: raise `relaxation` in the plant, '
                    'or begin the trajectory without contact'
                )
            advance(model, data)
            quiet = quiet + 1 if np.abs(data.cvel).max() < rest_speed else 0
    finally:
        model.dof_damping[:] = damping
    data.qvel[:] = 0.0


def uniform_rod(
    links: int,
    length: float,
    EI: float,
    mass_per_metre: float,
    *,
    EA: float | None = None,
    GJ: float | None = None,
    supported: bool = False,
    relaxation: float = 0.05,
    time_step: float = 0.005,
) -> mujoco.MjModel:
    """
    Make a plain rod along x, clamped at the origin, for comparison with mechanics.

    Without GJ it has that of the ball joints alone, EI.

    Its last body, `tip`, has no mass and lies at the rod's end: loads go there.
    """
    robot = RobotDescription(
        name='rod', length=length, radius=0.01 * length, rings=(Ring(name='end', s=length),)
    )
    profile = Profile(link_length=length / links, time_step=time_step)
    plant = PlantSettings(
        EI=EI,
        GJ=EI if GJ is None else GJ,
        EA=EA,
        mass_per_metre=mass_per_metre,
        relaxation=relaxation,
        profiles={'rod': profile},
    )
    spec = build_spec(robot, plant, None, 'rod', supported)
    tip = spec.body(f'{NODE_PREFIX}{links}').add_body(name='tip')
    tip.mass, tip.inertia, tip.explicitinertial = 1e-9, (1e-12, 1e-12, 1e-12), True
    return spec.compile()


def _check_step(plant: PlantSettings, time_step: float) -> None:
    """Check omega * step < 2 of the insertion drive, which alone is stepped explicitly."""
    omega = np.sqrt(plant.carriage_stiffness / plant.carriage_mass)
    if omega * time_step > 1.0:
        raise SettingsError(
            f'time_step {time_step} s is too long for the insertion drive '
            f'({omega:.0f} rad/s): use at most {1.0 / omega:.4f} s, or soften carriage_stiffness'
        )


def _add_rod(
    spec,
    robot: RobotDescription,
    plant: PlantSettings,
    nodes: np.ndarray,
    carried: Carrier | None,
) -> None:
    parent, joint_frame = _add_base(spec, robot, plant, carried)
    # half[i], half[i + 1]: reach of node i back, forth.
    half = np.concatenate([[0.0], np.diff(nodes) / 2.0, [0.0]])
    for i in range(len(nodes)):
        body = parent.add_body(name=f'{NODE_PREFIX}{i}', pos=joint_frame)
        if i > 0:
            _add_joints(body, i, plant, 2.0 * half[i])
        _add_link(body, robot, plant, half[i], half[i + 1])
        parent, joint_frame = (
            body,
            (half[i + 1] + (half[i + 1] if i + 1 < len(nodes) else 0.0), 0.0, 0.0),
        )


def _add_base(spec, robot: RobotDescription, plant: PlantSettings, carried: Carrier | None = None):
    """Add the body that the first node is fixed to, on the slide and drives that it has."""
    mujoco = require('mujoco', 'simulate')

    quat = np.roll(Rotation.from_matrix(robot.base.T_map_base[:3, :3]).as_quat(), 1)
    if carried is None:
        carriage = spec.worldbody.add_body(name='carriage', pos=robot.base.xyz, quat=quat)
    else:
        carriage = _add_carrier(spec, robot, plant, quat).add_body(name='carriage')
    if robot.base.insertion.mode != 'fixed':
        carriage.add_joint(
            name='insertion',
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=(1, 0, 0),
            armature=plant.carriage_mass,
        )
        drive = spec.add_actuator(
            name='insertion', trntype=mujoco.mjtTrn.mjTRN_JOINT, target='insertion'
        )
        drive.set_to_position(kp=plant.carriage_stiffness, kv=carriage_damping(plant))
    return carriage, (0.0, 0.0, 0.0)


def _add_carrier(spec, robot: RobotDescription, plant: PlantSettings, quat: np.ndarray):
    """Add the body of a carrier: three slides, then yaw, pitch and roll, each with its drive."""
    mujoco = require('mujoco', 'simulate')

    body = spec.worldbody.add_body(name='carrier', pos=robot.base.xyz, quat=quat)
    body.mass, body.inertia, body.explicitinertial = 1e-6, (1e-9, 1e-9, 1e-9), True
    kinds = [mujoco.mjtJoint.mjJNT_SLIDE] * 3 + [mujoco.mjtJoint.mjJNT_HINGE] * 3
    axes = [*np.eye(3), *np.eye(3)[::-1]]
    for name, kind, axis in zip(JOINTS, kinds, axes, strict=True):
        body.add_joint(name=name, type=kind, axis=axis, armature=plant.carriage_mass)
        drive = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        drive.set_to_position(kp=plant.carriage_stiffness, kv=carriage_damping(plant))
    return body


def carriage_damping(plant: PlantSettings) -> float:
    """Velocity gain [N s/m] that damps the insertion drive critically."""
    return 2.0 * np.sqrt(plant.carriage_stiffness * plant.carriage_mass)


def _add_joints(body, i: int, plant: PlantSettings, segment: float) -> None:
    """
    Add the spring between nodes i - 1 and i, in the middle of their segment.

    EI / h, and EA / h where it stretches.
    """
    import mujoco

    pos = (-segment / 2.0, 0.0, 0.0)
    if plant.EA is not None:
        body.add_joint(
            name=f'stretch{i}',
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=(1, 0, 0),
            pos=pos,
            stiffness=[plant.EA / segment, 0, 0],
            damping=[plant.relaxation * plant.EA / segment, 0, 0],
        )
    bend = body.add_joint(
        name=f'bend{i}',
        type=mujoco.mjtJoint.mjJNT_BALL,
        pos=pos,
        stiffness=[plant.EI / segment, 0, 0],
        damping=[plant.relaxation * plant.EI / segment, 0, 0],
    )
    if plant.GJ != plant.EI:
        bend.userdata = [(plant.EI - plant.GJ) / segment]


def _add_link(
    body, robot: RobotDescription, plant: PlantSettings, back: float, forth: float
) -> None:
    """Add a link from -back to +forth of the node, a solid cylinder that touches as a capsule."""
    import mujoco

    length, centre = back + forth, (forth - back) / 2.0
    mass = plant.mass_per_metre * length
    axial = mass * robot.radius**2 / 2.0
    across = mass * (robot.radius**2 / 4.0 + length**2 / 12.0)
    if min(mass, axial, across) < LEAST_INERTIA:
        raise SettingsError(
            f'plant: mass_per_metre = {plant.mass_per_metre} kg/m makes links of {mass:.3g} kg '
            f'and {min(axial, across):.3g} kg m^2; both must be above {LEAST_INERTIA}: give the '
            'true mass, or longer links'
        )
    body.mass, body.ipos, body.inertia = mass, (centre, 0.0, 0.0), (axial, across, across)
    body.explicitinertial = True
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=(-back, 0, 0, forth, 0, 0),
        size=(robot.radius, 0, 0),
        mass=0.0,
        friction=(plant.contact_friction, 0.005, 0.0001),
        contype=ROBOT_BIT,
        conaffinity=SCENE_BIT,
        rgba=(0.9, 0.6, 0.2, 1.0),
    )


def _add_tendons(spec, plant: PlantSettings, nodes: np.ndarray) -> None:
    """
    Thread each tendon through every link up to its module's end; its actuator pulls ctrl newtons.

    A channel opens at GUIDE / 2 of a segment from each joint. Its straight stretch across the
    joint has the moment arm r cos(phi / 2) + GUIDE h / 2 sin(phi / 2): short stretches keep the
    second term, which a rod that is guided all along does not have, small.
    """
    import mujoco

    names = iter(plant.tendon_names)
    # From a node to the channel's mouth, in each segment.
    reach = (1.0 - GUIDE) / 2.0 * np.diff(nodes)
    openings = [mouth for i, x in enumerate(reach) for mouth in ((i, x), (i + 1, -x))]
    for group in plant.tendons:
        last = int(np.argmin(np.abs(nodes - group.end)))
        for azimuth in np.radians(group.azimuth_deg):
            name = next(names)
            offset = (group.radius * np.cos(azimuth), group.radius * np.sin(azimuth))
            tendon = spec.add_tendon(
                name=name, frictionloss=group.friction, solimp_friction=STICTION
            )
            for k, (i, x) in enumerate([(0, 0.0), *openings[: 2 * last], (last, 0.0)]):
                site = f'{name}_site{k}'
                spec.body(f'{NODE_PREFIX}{i}').add_site(name=site, pos=(x, *offset), group=4)
                tendon.wrap_site(site)
            pull = spec.add_actuator(
                name=name,
                trntype=mujoco.mjtTrn.mjTRN_TENDON,
                target=name,
                ctrllimited=True,
                ctrlrange=(0.0, group.max_force),
            )
            pull.set_to_motor()
            pull.gear = (-1.0, 0, 0, 0, 0, 0)


def _add_scene(
    spec, robot: RobotDescription, plant: PlantSettings, scene, carried: Carrier | None = None
) -> None:
    """Convex pieces that the robot can reach, as fixed geoms."""
    import mujoco

    for i, vertices in enumerate(scene.hulls):
        if not _reachable(robot, vertices, carried):
            continue
        spec.add_mesh(name=f'hull{i}', uservert=vertices.ravel())
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f'hull{i}',
            group=3,
            mass=0.0,
            friction=(plant.contact_friction, 0.005, 0.0001),
            contype=SCENE_BIT,
            conaffinity=ROBOT_BIT,
            rgba=(0.3, 0.7, 0.3, 1.0),
        )


def _reachable(
    robot: RobotDescription, vertices: np.ndarray, carried: Carrier | None = None
) -> bool:
    """Whether a piece's bounding box meets the capsule that the rod may reach."""
    T = robot.base.T_map_base
    travel = np.linspace(*robot.base.insertion.range, 8)
    origins = T[:3, 3] + travel[:, None] * T[:3, 0]
    if carried is not None:
        inserted = np.column_stack([travel, np.zeros((8, 2)), np.ones(8)])
        poses = T @ pose_of(carried.values)
        origins = (poses[:, None] @ inserted[..., None])[..., :3, 0].reshape(-1, 3)
    nearest = np.clip(origins, vertices.min(axis=0), vertices.max(axis=0))
    distance = np.linalg.norm(nearest - origins, axis=1).min()
    return bool(distance < robot.length + 2.0 * robot.radius)
