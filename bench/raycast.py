"""
One frame of ToF rays against 150,000 faces, beside MuJoCo's ray casters and Open3D.

`run(quick)` gives a list of rows, each ours against one peer on one workload, on one core,
alternating the two:
- *frame*: 16 sensors x 64 rays, as the `paper` fidelity casts them;
- *sub-rays*: 16 sensors x 1024 rays, as `vl53l5cx` does;
- *body*: a frame against the robot's own 150 capsules.

Ours also looks up normals and faces; MuJoCo's casters are asked for distances alone.
"""

from __future__ import annotations

from collections.abc import Callable

from bench.harness import one_core, side_by_side
from continuum_loc.robot import load_robot
from continuum_loc.simulator.raycast import cast_capsules, RayCaster
from continuum_loc.simulator.scene import Scene, scene_of_solid
from continuum_loc.simulator.scenes import load_scene
from continuum_loc.simulator.solids import Part, solid_of
import numpy as np

FACES = 150_000
Action = Callable[[], object]


def run(quick: bool = False) -> list[dict]:
    """Rows as `bench.harness` describes them; times are seconds per frame."""
    scene = engine_scene()
    caster, model, data = RayCaster(scene), *_mujoco_scene(scene)
    frame, repeats, rows = _fans(1), 2 if quick else 10, []
    with one_core():
        for name, fan, slow_repeats in (
            ('rays, frame', frame, repeats),
            ('rays, sub-rays', _fans(4), 2),
        ):
            ours = _ours(caster, *fan)
            rows.append(
                side_by_side(
                    name, ours, 'Open3D RaycastingScene', _open3d(scene, *fan), 5 * repeats
                )
            )
            rows.append(
                side_by_side(
                    name, ours, 'mj_multiRay', _multi_ray(model, data, *fan), slow_repeats
                )
            )
        ours = _ours(caster, *frame)
        rows.append(
            side_by_side('rays, frame', ours, 'mj_ray', _single_rays(model, data, *frame), repeats)
        )
        rows.append(
            side_by_side(
                'rays, frame', ours, 'MuJoCo rangefinders', _rangefinders(scene, *frame), repeats
            )
        )
        rows.append(side_by_side('rays, body', *_body(*frame), 5 * repeats))
    return rows


def engine_scene() -> Scene:
    """Scene S0 with its faces split until there are at least `FACES`."""
    scene, length = load_scene('S0'), 1.0
    while len(scene.faces) < FACES:
        solid = solid_of(scene.vertices, scene.faces).refine_to_length(length).as_original()
        scene = scene_of_solid(
            'S0', solid, np.zeros(solid.num_tri(), dtype=np.int32), [Part('engine', solid)]
        )
        length /= 1.2
    return scene


def _fans(sub_rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins (16, 3) and rays (16, K, 3) of the straight engine robot, inserted by 0.3 m."""
    robot = load_robot('engine')
    fine = robot.tof_model.model_dump() | {'rows': 8 * sub_rays, 'columns': 8 * sub_rays}
    directions = type(robot.tof_model).model_validate(fine).directions
    T_map_sensors = np.stack([_on_straight_robot(robot, sensor) for sensor in robot.tof])
    return np.ascontiguousarray(T_map_sensors[:, :3, 3]), directions @ T_map_sensors[
        :, :3, :3
    ].transpose(0, 2, 1)


def _on_straight_robot(robot, sensor) -> np.ndarray:
    T_base_ring = np.eye(4)
    T_base_ring[0, 3] = 0.3 + robot.sensor_arclength(sensor.name)
    return robot.base.T_map_base @ T_base_ring @ sensor.mount.T_ring_sensor


def _ours(caster: RayCaster, origins: np.ndarray, rays: np.ndarray) -> Action:
    return lambda: caster.cast(np.repeat(origins, rays.shape[1], axis=0), rays.reshape(-1, 3))


def _open3d(scene: Scene, origins: np.ndarray, rays: np.ndarray) -> Action:
    import open3d

    direct = open3d.t.geometry.RaycastingScene(nthreads=1)
    direct.add_triangles(
        open3d.core.Tensor(scene.vertices.astype(np.float32)),
        open3d.core.Tensor(scene.faces.astype(np.uint32)),
    )
    flat = np.concatenate([np.repeat(origins, rays.shape[1], axis=0), rays.reshape(-1, 3)], axis=1)
    packed = open3d.core.Tensor(flat.astype(np.float32))
    return lambda: direct.cast_rays(packed)['t_hit'].numpy()


def _mujoco_scene(scene: Scene, prepare: Callable | None = None):
    import mujoco

    spec = mujoco.MjSpec()
    spec.add_mesh(
        name='scene',
        uservert=scene.vertices.ravel(),
        userface=scene.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname='scene', contype=0, conaffinity=0
    )
    if prepare:
        prepare(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def _multi_ray(model, data, origins: np.ndarray, rays: np.ndarray) -> Action:
    """One call per sensor: mj_multiRay's rays share their origin."""
    import mujoco

    count = rays.shape[1]
    geom, distance = np.zeros(count, np.int32), np.zeros(count)
    flat = [np.ascontiguousarray(fan).ravel() for fan in rays]

    def cast() -> None:
        for origin, fan in zip(origins, flat, strict=True):
            mujoco.mj_multiRay(
                model, data, origin, fan, None, 1, -1, geom, distance, None, count, 1e10
            )

    return cast


def _single_rays(model, data, origins: np.ndarray, rays: np.ndarray) -> Action:
    import mujoco

    geom = np.zeros(1, np.int32)
    pairs = [(origin, ray) for origin, fan in zip(origins, rays, strict=True) for ray in fan]
    return lambda: [
        mujoco.mj_ray(model, data, origin, ray, None, 1, -1, geom) for origin, ray in pairs
    ]


def _rangefinders(scene: Scene, origins: np.ndarray, rays: np.ndarray) -> Action:
    """1024 site rangefinders, as the paper simulates its sensors."""
    import mujoco

    def add_sensors(spec) -> None:
        head = spec.worldbody.add_body()  # a rangefinder does not see its own body's geoms
        for i, (origin, fan) in enumerate(zip(origins, rays, strict=True)):
            for j, ray in enumerate(fan):
                site = head.add_site(name=f'zone_{i}_{j}', pos=origin)
                site.alt.type, site.alt.zaxis = mujoco.mjtOrientation.mjORIENTATION_ZAXIS, ray
                # Distance alone.
                spec.add_sensor(
                    type=mujoco.mjtSensor.mjSENS_RANGEFINDER,
                    objtype=mujoco.mjtObj.mjOBJ_SITE,
                    objname=f'zone_{i}_{j}',
                    intprm=[1, 0, 0],
                )

    model, data = _mujoco_scene(scene, add_sensors)
    expected = _ours(RayCaster(scene), origins, rays)()[0]
    seen = data.sensordata > 0.0
    if (
        np.mean(np.isclose(data.sensordata[seen], expected[seen], atol=1e-5)) < 0.99
        or seen.mean() < 0.5
    ):
        raise RuntimeError(
            "MuJoCo's rangefinders do not measure what ours do: the comparison would be void"
        )
    return lambda: mujoco.mj_sensorPos(model, data)


def _body(origins: np.ndarray, rays: np.ndarray) -> tuple[Action, str, Action]:
    """
    Cast to the robot's 150 links as capsules.

    Our kernel beside mj_multiRay on as many capsule geoms.
    """
    import mujoco

    robot = load_robot('engine')
    stations = (
        np.linspace(0.3, 0.3 + robot.length, 151)[:, None] * [1.0, 0.0, 0.0] + robot.base.xyz
    )
    capsules = np.column_stack([stations[:-1], stations[1:], np.full(150, robot.radius)])
    spec = mujoco.MjSpec()
    for capsule in capsules:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=capsule[:6], size=[capsule[6], 0.0, 0.0]
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rays = np.ascontiguousarray(rays)
    return (
        lambda: cast_capsules(origins, rays, capsules),
        'mj_multiRay',
        _multi_ray(model, data, origins, rays),
    )


if __name__ == '__main__':
    for row in run():
        print(
            f'{row["name"]:16s} {row["ours_s"] * 1e3:8.3f} ms   {row["peer"]:24s} '
            f'{row["peer_s"] * 1e3:9.2f} ms   {row["ratio"]:7.1f} x  ({row["spread"][0]:.1f} to '
            f'{row["spread"][1]:.1f})'
        )
