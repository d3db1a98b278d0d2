"""
The simulator against mechanics, its sensors against their models, and its speed.

Statics against closed forms and a Cosserat rod, convergence in the number of links, the first mode
and the damping that the integrator adds; the distribution of every sensor's noise; gyro,
accelerometer and strain against the true motion; contact, and how far contact pieces stand out;
and the real-time factor of the live engine robot.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import time
from typing import Any

from continuum_loc import lie
from continuum_loc.measurements import (
    EncoderSample,
    FieldSample,
    ImuSample,
    StrainSample,
    TofFrame,
    TruthSample,
)
from continuum_loc.offline.claims import at_least, at_most, between, Claim, write_study
from continuum_loc.robot import load_robot, RobotDescription
from continuum_loc.simulator.model import advance, GRAVITY, settle, uniform_rod
from continuum_loc.simulator.plant import load_plant
from continuum_loc.simulator.trajectories import REST
from continuum_loc.simulator.world import World
import numpy as np
from studies import _pieces, _vl53l5cx
from studies.support.cosserat import cosserat_shape, elastica_tip, first_frequency

LENGTH, EI, MASS = 1.0, 0.05, 0.02  # the rod of the statics: 1 m, 0.05 N m^2, 20 g
COSSERAT_LINKS = 24
# Rods of 0.3 m for the comparison of shapes: EI [N m^2] and mass [kg/m] of steel wire and of a TPU
# strip.
RODS = {'steel wire 1 mm': (9.8e-3, 6.2e-3), 'TPU rod 10 mm': (1.5e-2, 9.4e-2)}
ROD_LENGTH = 0.3
# GJ / EI: of round rods 1 / (1 + nu), nu 0.3 for steel and 0.48 for TPU; and near both bounds.
TORSION = (0.2, 1.0 / 1.48, 1.0 / 1.3, 1.7)
SURFACE = 7.0  # greatest distance of the engine's own contact pieces from its surface [mm]
FALSE_ALARM = 1e-3  # of each noise test
# Greatest penetration [mm]: the engine robot leans; the soft arm is swung against rigid objects at
# a metre a second, and is 76 mm thick.
PENETRATION = {'S': 5.0, 'R': 10.0}
TINY = 1e-12
_GREATEST = 'stands out, greatest [mm]'


def run(out: Path, quick: bool, seed: int, jobs: int) -> list[Claim]:
    """
    Claims of the study, with tables under `out`.

    Tables of statics, shapes, vibration, noise and motion.
    """
    statics = [*_statics((12, 24, 50) if quick else (6, 12, 24, 50, 100, 150))]
    shapes = [*_shapes(3 if quick else 20, seed)]
    twisted = [*_torsion(1 if quick else 4, seed)]
    vibration = [first_mode(24, step) for step in (0.002, 0.005)]
    noise = [*_noise(seed), *_vl53l5cx.noise(seed)]
    motion = [
        _consistency('t2', 5.0 if quick else 20.0),
        *_contact(
            'engine', [('S0', t) for t in (('t3',) if quick else ('t1', 't2', 't3'))], quick
        ),
        *_contact('soft_arm', [('R1', 'b6'), ('R2', 'b7'), ('R3', 'b8')], quick),
    ]
    pieces = _pieces.contact_pieces(quick)
    speed = real_time_factor(3.0 if quick else 20.0, seed)
    claims = [
        *_statics_claims(statics),
        *_shape_claims(shapes),
        *_torsion_claims(twisted),
        *_vibration_claims(vibration),
        *(
            at_least(f'p-value of the {row["sensor"]} noise', row['p_value'], '', FALSE_ALARM)
            for row in noise
        ),
        *_mechanism_claims(_vl53l5cx.mechanisms(seed)),
        *_motion_claims(motion),
        *_pieces_claims(pieces),
        at_least(
            'real-time factor, live engine, contacts, 16 ToF in vl53l5cx, one core', speed, '', 1.5
        ),
    ]
    write_study(
        out,
        claims,
        seed=seed,
        settings={'quick': quick, 'engine': load_plant('engine')},
        tables={
            'statics': statics,
            'shapes': shapes,
            'torsion': twisted,
            'pieces': pieces,
            'vibration': vibration,
            'noise': noise,
            'motion': motion,
        },
    )
    return claims


# --------------------------------------------------------------------------- statics


def settled_tip(model: Any, force: np.ndarray, moment: np.ndarray) -> np.ndarray:
    """(4, 4) T_map_tip of a `uniform_rod` at rest under an end force [N] and moment [N m]."""
    import mujoco

    data = mujoco.MjData(model)
    data.xfrc_applied[-1] = np.concatenate([force, moment])
    settle(model, data, rest_speed=1e-6)
    mujoco.mj_forward(model, data)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.body('tip').xmat.reshape(3, 3), data.body('tip').xpos
    return T


def _static_cases() -> dict[str, tuple[np.ndarray, np.ndarray, bool, np.ndarray]]:
    """End force, end moment, whether weightless, and the tip that mechanics gives."""
    none, angle, load = np.zeros(3), 2.0, 0.2
    x, drop = elastica_tip(load, EI, LENGTH)
    arc = np.array([np.sin(angle), 0.0, np.cos(angle) - 1.0]) * LENGTH / angle
    sag = cosserat_shape([LENGTH], LENGTH, EI, EI, weight=MASS * GRAVITY)[0, :3, 3]
    small = 1e-3
    return {
        'small end load, P L^3 / 3 EI': (
            np.array([0, 0, -small]),
            none,
            True,
            np.array([LENGTH, 0.0, -small * LENGTH**3 / (3 * EI)]),
        ),
        'elastica (Bisshopp and Drucker)': (
            np.array([0, 0, -load]),
            none,
            True,
            np.array([x, 0.0, -drop]),
        ),
        'pure bending, 115 deg': (none, np.array([0, angle * EI / LENGTH, 0]), True, arc),
        'own weight': (none, none, False, sag),
    }


def _statics(link_counts: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    for name, (force, moment, weightless, expected) in _static_cases().items():
        for links in link_counts:
            tip = settled_tip(
                uniform_rod(links, LENGTH, EI, MASS, supported=weightless), force, moment
            )
            error = np.linalg.norm(tip[:3, 3] - expected)
            yield {'case': name, 'links': links, 'tip error [% of length]': 100.0 * error / LENGTH}


def _statics_claims(rows: list[dict[str, Any]]) -> Iterator[Claim]:
    for name in dict.fromkeys(row['case'] for row in rows):
        errors = {
            row['links']: row['tip error [% of length]'] for row in rows if row['case'] == name
        }
        yield at_most(f'{name}: tip error at 24 links', errors[24], '% of length', 0.5)
    elastica = {
        row['links']: row['tip error [% of length]']
        for row in rows
        if row['case'].startswith('elastica')
    }
    coarse, fine = 12, 50
    order = np.log(elastica[coarse] / elastica[fine]) / np.log(fine / coarse)
    yield between('order of convergence in the link length (elastica)', order, '', 1.8, 2.2)


def _shapes(cases: int, seed: int) -> Iterator[dict[str, Any]]:
    """
    Tip errors against the Cosserat rod under random loads.

    They bend the rod by some tens of degrees.
    """
    rng = np.random.default_rng(seed)
    for name, (stiffness, mass) in RODS.items():
        model = uniform_rod(COSSERAT_LINKS, ROD_LENGTH, stiffness, mass)
        for _ in range(cases):
            force = rng.normal(0.0, 0.5 * stiffness / ROD_LENGTH**2, 3)
            moment = rng.normal(0.0, 0.3 * stiffness / ROD_LENGTH, 3)
            expected = cosserat_shape(
                [ROD_LENGTH],
                ROD_LENGTH,
                stiffness,
                stiffness,
                weight=mass * GRAVITY,
                tip_force=force,
                tip_moment=moment,
            )[0]
            tip = settled_tip(model, force, moment)
            yield {
                'rod': name,
                'tip moved [mm]': 1e3 * np.linalg.norm(expected[:3, 3] - [ROD_LENGTH, 0.0, 0.0]),
                'tip error [mm]': 1e3 * np.linalg.norm(tip[:3, 3] - expected[:3, 3]),
                'tip error [deg]': float(lie.rotation_error_deg(tip[:3, :3], expected[:3, :3])),
            }


def _shape_claims(rows: list[dict[str, Any]]) -> Iterator[Claim]:
    for name in RODS:
        mean = np.mean([row['tip error [mm]'] for row in rows if row['rod'] == name])
        yield at_most(
            f'{name}, {COSSERAT_LINKS} links against a Cosserat rod: mean tip error',
            mean,
            'mm',
            0.3,
        )


def _torsion(cases: int, seed: int) -> Iterator[dict[str, Any]]:
    """
    Tip rotations against the Cosserat rod where GJ is not EI.

    Loads at the tip; they turn it by the rod's torsion, which does not move it.
    """
    rng = np.random.default_rng(seed)
    stiffness, mass = RODS['steel wire 1 mm']
    for ratio in TORSION:
        model = uniform_rod(
            COSSERAT_LINKS, ROD_LENGTH, stiffness, mass, GJ=ratio * stiffness, supported=True
        )
        for _ in range(cases):
            force = rng.normal(0.0, 0.5 * stiffness / ROD_LENGTH**2, 3)
            moment = rng.normal(0.0, 0.3 * stiffness / ROD_LENGTH, 3)
            expected, without = (
                cosserat_shape(
                    [ROD_LENGTH],
                    ROD_LENGTH,
                    stiffness,
                    GJ,
                    tip_force=force,
                    tip_moment=moment,
                )[0, :3, :3]
                for GJ in (ratio * stiffness, stiffness)
            )
            tip = settled_tip(model, force, moment)[:3, :3]
            yield {
                'GJ / EI': ratio,
                'GJ turns the tip by [deg]': float(lie.rotation_error_deg(expected, without)),
                'tip error [deg]': float(lie.rotation_error_deg(tip, expected)),
            }


def _torsion_claims(rows: list[dict[str, Any]]) -> Iterator[Claim]:
    for ratio in TORSION:
        errors, turns = (
            np.mean([row[key] for row in rows if row['GJ / EI'] == ratio])
            for key in ('tip error [deg]', 'GJ turns the tip by [deg]')
        )
        yield at_most(
            f'GJ / EI = {ratio:.2f}: tip rotation error, of the {turns:.1f} deg that GJ makes',
            100.0 * errors / turns,
            '%',
            3.0,
        )


# --------------------------------------------------------------------------- vibration


def first_mode(links: int, time_step: float, duration: float = 8.0) -> dict[str, float]:
    """
    Frequency and damping of a weightless rod without damping of its own.

    It is let go from a small static bend.
    """
    model = uniform_rod(links, LENGTH, EI, MASS, supported=True, time_step=time_step)
    frequency, damping = _ring_down(_released(model, duration), time_step)
    expected = first_frequency(EI, MASS, LENGTH)
    return {
        'links': links,
        'time step [s]': time_step,
        'frequency [Hz]': frequency,
        'Euler-Bernoulli [Hz]': expected,
        'damping ratio': damping,
        'omega h / 2': np.pi * expected * time_step,
    }


def _released(model: Any, duration: float) -> np.ndarray:
    """Record the tip's y [m] after the load is gone, where the integrator alone damps it."""
    import mujoco

    data = mujoco.MjData(model)
    data.xfrc_applied[-1, 1] = 1e-3
    settle(model, data, rest_speed=1e-7)
    data.xfrc_applied[:] = 0.0
    model.dof_damping[:] = 0.0
    y = np.empty(round(duration / model.opt.timestep))
    for k in range(len(y)):
        advance(model, data)
        y[k] = data.body('tip').xpos[1]
    return y


def _ring_down(y: np.ndarray, time_step: float) -> tuple[float, float]:
    """
    Frequency [Hz] from the rising zero crossings, damping ratio from the decrement.

    The decrement is that of the peaks between the crossings.
    """
    rising = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    crossings = time_step * (rising - y[rising] / (y[rising + 1] - y[rising]))
    peaks = np.array([y[a:b].max() for a, b in zip(rising, rising[1:], strict=False)])
    decrement = np.log(peaks[1] / peaks[-1]) / (len(peaks) - 2)
    return float(1.0 / np.diff(crossings).mean()), float(decrement / (2 * np.pi))


def _vibration_claims(rows: list[dict[str, float]]) -> Iterator[Claim]:
    for row in rows:
        step = f'{1e3 * row["time step [s]"]:g} ms'
        error = 100.0 * abs(row['frequency [Hz]'] / row['Euler-Bernoulli [Hz]'] - 1.0)
        yield at_most(f'first mode at {step}: frequency error', error, '%', 2.0)
        yield between(
            f"first mode at {step}: integrator's damping over omega h / 2",
            row['damping ratio'] / row['omega h / 2'],
            '',
            0.9,
            1.1,
        )


# --------------------------------------------------------------------------- noise


def _noise(seed: int) -> Iterator[dict[str, Any]]:
    """Kolmogorov-Smirnov p-value of each sensor's error at rest over its sigma, for N(0, 1)."""
    from scipy import stats

    for sensor, z in _normalised_errors(seed):
        yield {
            'sensor': sensor,
            'samples': z.size,
            'mean': z.mean(),
            'standard deviation': z.std(),
            'p_value': float(stats.kstest(z.ravel(), 'norm').pvalue),
        }


def _normalised_errors(seed: int) -> Iterator[tuple[str, np.ndarray]]:
    engine, arm = load_robot('engine'), load_robot('hall_arm')
    noisy, clean = (_resting(robot, seed) for robot in (engine, _quiet(engine)))
    imu, strain = engine.imu_model, engine.strain
    yield 'gyro', _difference(noisy, clean, ImuSample, 'angular_velocity') / imu.gyro_sigma
    yield (
        'accelerometer',
        _difference(noisy, clean, ImuSample, 'linear_acceleration') / imu.accel_sigma,
    )
    yield 'curvature', _difference(noisy, clean, StrainSample, 'kappa') / strain.kappa_sigma
    yield 'bending angle', _difference(noisy, clean, StrainSample, 'theta') / strain.theta_sigma
    yield (
        'insertion encoder',
        _difference(noisy, clean, EncoderSample, 'position')[:, -1] / engine.base.insertion.sigma,
    )
    yield 'ToF range (Table I)', _tof_errors(engine, seed)
    arm = arm.model_copy(
        update={'hall_model': arm.hall_model.model_copy(update={'lsb': (TINY,) * 3})}
    )
    noisy, clean = (_resting(robot, seed) for robot in (arm, _quiet(arm)))
    yield 'Hall field', _difference(noisy, clean, FieldSample, 'field') / arm.hall_model.sigma


def _resting(robot: RobotDescription, seed: int) -> list[Any]:
    name = 't1' if robot.name == 'engine' else 'straight'
    return list(World(robot, None, name, seed=seed).run(REST))


def _quiet(robot: RobotDescription) -> RobotDescription:
    """Give the robot sensors that read the truth; biases stay, drawn from the same stream."""
    imu = robot.imu_model.model_copy(update={'gyro_sigma': TINY, 'accel_sigma': TINY})
    strain = robot.strain and robot.strain.model_copy(
        update={'kappa_sigma': TINY, 'theta_sigma': TINY}
    )
    hall = robot.hall_model.model_copy(update={'sigma': TINY**2})
    insertion = robot.base.insertion.model_copy(update={'sigma': TINY})
    base = robot.base.model_copy(update={'insertion': insertion})
    return robot.model_copy(
        update={'imu_model': imu, 'strain': strain, 'hall_model': hall, 'base': base}
    )


def _difference(noisy: list, clean: list, kind: type, field: str) -> np.ndarray:
    """(K, n) of a field of one kind of sample, noisy less clean."""
    values = [
        np.array([getattr(s, field) for s in samples if type(s) is kind])
        for samples in (noisy, clean)
    ]
    return values[0] - values[1]


def _tof_errors(robot: RobotDescription, seed: int) -> np.ndarray:
    """Errors of valid ranges over Table I's sigma at the true range."""
    from continuum_loc.simulator.scenes import load_scene

    silent = robot.tof_model.model_copy(update={'noise_coefficient': (TINY,) * 3})
    silent_robot = robot.model_copy(update={'tof_model': silent})
    noisy, true = (
        np.array(
            [
                s.ranges
                for s in World(r, load_scene('S0'), 't1', seed=seed).run(REST)
                if type(s) is TofFrame
            ]
        )
        for r in (robot, silent_robot)
    )
    seen = np.isfinite(noisy) & np.isfinite(true)
    return (noisy[seen] - true[seen]) / robot.tof_model.sigma(true[seen])


def _mechanism_claims(found: dict[str, float]) -> Iterator[Claim]:
    yield at_most('VL53L5CX depth: departure from whole millimetres', found['rounding'], 'm', 1e-9)
    yield at_least(
        'VL53L5CX status 9: share of zones flagged as their spread of depth says',
        found['wide'],
        '',
        1.0,
    )


# -------------------------------------------------------------------------- motion, contact, speed


def _consistency(trajectory: str, duration: float) -> dict[str, Any]:
    """RMS of the gyros' departure from the chords of the true rotation, in % of the motion's."""
    robot = _quiet(load_robot('engine'))
    samples = list(World(robot, None, trajectory).run(duration))
    truth = np.array([s.T_map_ring for s in samples if type(s) is TruthSample])
    worst = 0.0
    for ring, name in enumerate(robot.ring_names, start=1):
        gyro = np.array(
            [
                s.angular_velocity
                for s in samples
                if type(s) is ImuSample and s.sensor == f'{name}_imu'
            ]
        )
        R = truth[:, ring, :3, :3]
        chord = lie.so3_log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * robot.imu_model.rate
        worst = max(worst, np.std((gyro[:-1] + gyro[1:]) / 2.0 - chord) / np.std(chord))
    return {'trajectory': trajectory, 'scene': 'none', 'gyro against truth [%]': 100.0 * worst}


def _contact(
    robot_name: str, trials: list[tuple[str, str]], quick: bool
) -> Iterator[dict[str, Any]]:
    """How deep and how often the robot touches each (scene, trajectory)."""
    from continuum_loc.simulator.scenes import load_scene

    robot = load_robot(robot_name).model_copy(update={'tof': ()})
    for scene, name in trials:
        world = World(robot, load_scene(scene), name)
        depth = np.array(
            [
                world.body.penetration()
                for sample in world.run(9.0 if quick else None)
                if type(sample) is TruthSample
            ]
        )
        touching = depth > 0.0
        yield {
            'trajectory': name,
            'scene': scene,
            'in contact [%]': 100.0 * touching.mean(),
            'penetration, median [mm]': 1e3 * np.median(depth[touching])
            if touching.any()
            else 0.0,
            'penetration, greatest [mm]': 1e3 * depth.max(),
        }


def _motion_claims(rows: list[dict[str, Any]]) -> Iterator[Claim]:
    yield at_most(
        'gyro against the chords of the true rotation, rms',
        rows[0]['gyro against truth [%]'],
        '%',
        2.0,
    )
    for row in rows[1:]:
        where = f'{row["trajectory"]} in {row["scene"]}'
        yield at_most(
            f'greatest penetration, {where}',
            row['penetration, greatest [mm]'],
            'mm',
            PENETRATION[row['scene'][0]],
        )
        if row['scene'] != 'S0':
            yield at_least(f'time in contact, {where}', row['in contact [%]'], '%', 0.1)


def _pieces_claims(rows: list[dict[str, Any]]) -> Iterator[Claim]:
    own, _, cut = rows
    yield at_most(
        "S0's own contact pieces, short of the casing, stand out of its surface by",
        own[_GREATEST],
        'mm',
        SURFACE,
    )
    yield at_most(
        f'{cut["pieces"]} pieces cut from S0 as one mesh stand out of its surface by',
        cut[_GREATEST],
        'mm',
        cut['tolerance [mm]'] + 1e3 * _pieces.ROUNDING,
    )


def real_time_factor(duration: float, seed: int = 0, fidelity: str = 'vl53l5cx') -> float:
    """
    Run the live engine robot: its simulated seconds per second of processor time.

    On t1 in S0, with contacts and all sensors.
    """
    from continuum_loc.simulator.scenes import load_scene

    world = World(load_robot('engine'), load_scene('S0'), 't1', tof_fidelity=fidelity, seed=seed)
    return 1.0 / seconds_of_processor(world, duration)


def seconds_of_processor(world: World, duration: float) -> float:
    """Processor time of a simulated second, after what is compiled and settled once."""
    for _ in world.run(0.2):
        pass
    samples = world.run(duration)
    next(samples)
    start = time.process_time()
    for _ in samples:
        pass
    return (time.process_time() - start) / duration
