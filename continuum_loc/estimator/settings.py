"""
Every number of the filter that can be tuned, with its unit.

`continuum-loc tune` writes such a file.
"""

from __future__ import annotations

from pathlib import Path

from continuum_loc.robot import Vector6
from continuum_loc.settings import load_bundled, Settings
from pydantic import Field

PRESETS_FOLDER = Path(__file__).parent / 'presets'


class PriorSettings(Settings):
    """Process noise: spectral densities of body-frame rates, translation then rotation."""

    velocity: Vector6 = Field(
        (0.1, 0.1, 0.1, 3.0, 3.0, 3.0),
        description='white noise on acceleration, in time [m^2/s^3, rad^2/s^3]',
    )
    strain_rate: Vector6 = Field(
        (1e-4, 1e-4, 1e-4, 1e-2, 4.0, 4.0),
        description='random walk of the strain, in time [1/s, 1/(m^2 s)]',
    )
    velocity_at_base: float = Field(
        1.0,
        gt=0.0,
        le=1.0,
        description='share of that noise at the base; it grows with the square of the arclength',
    )
    strain: Vector6 = Field(
        (1e-5, 1e-5, 1e-5, 1e-3, 15.0, 15.0),
        description="white noise on the strain's slope, in arclength [1/m, 1/m^3]",
    )
    strain_step: Vector6 = Field(
        (0.0, 0.0, 0.0, 0.0, 5.0, 5.0),
        description='spread of the step at a module end of the robot description [1, 1/m]',
    )
    velocity_slope: Vector6 = Field(
        (0.01, 0.01, 0.01, 1.0, 1.0, 1.0),
        description='random walk of the velocity, in arclength [m/s^2, rad^2/(s^2 m)]',
    )
    initial_velocity_sigma: tuple[float, float] = Field(
        (0.05, 0.1), description='spread of the velocity at the first instant [m/s, rad/s]'
    )
    cauchy: float = Field(
        1.0,
        gt=0.0,
        description="scale of the Cauchy loss on a node's step from knot to knot, in sigmas (root "
        'mean square of its components): a brisk motion gets more process noise by itself; large '
        'switches it off',
    )
    jerked: float = Field(
        20.0, ge=1.0, description='most that a jerk multiplies the process noise of a step by'
    )
    memory: float = Field(
        1.0,
        gt=0.0,
        description='time over which the rest strain and the base pose count as one '
        'independent observation [s]',
    )


class TofSettings(Settings):
    """Point-to-plane factors."""

    enabled: bool = True
    floor: float = Field(
        0.003, ge=0.0, description="noise added to the datasheet's, across the surface [m]"
    )
    footprint: float = Field(
        0.0,
        ge=0.0,
        description="share of a zone's half width counted as noise on slanted "
        'surfaces (1 for a sensor that integrates over its zones)',
    )
    cauchy: float = Field(
        2.0, gt=0.0, description='scale of the Cauchy loss in sigmas; large switches it off'
    )
    acquisition_cauchy: float = Field(
        2.0, gt=0.0, description='the same before the first fit and when lost [sigmas]'
    )
    gate: float = Field(0.12, gt=0.0, description='farthest map point that a zone may match [m]')
    acquisition_gate: float = Field(
        0.5, gt=0.0, description='the same before the first fit and when lost [m]'
    )
    reassociate: float = Field(
        0.001, ge=0.0, description='a zone that moved farther is matched to the map anew [m]'
    )
    min_cosine: float = Field(
        0.15, ge=0.0, lt=1.0, description='least cosine of incidence for a match'
    )
    planarity_power: float = Field(
        1.0,
        ge=0.0,
        description="weight = (planarity over the map's median, at most 1) ** power; 0 switches "
        'it off',
    )


class GyroSettings(Settings):
    """Gyro factors."""

    enabled: bool = True
    scale: float = Field(1.5, gt=0.0, description="factor on the datasheet's noise")
    cauchy: float = Field(
        10.0,
        gt=0.0,
        description="scale of the Cauchy loss on an IMU's samples between two knots, in sigmas "
        '(their root mean square): they count less where the body rattles faster than the knots',
    )
    bias_sigma: float = Field(0.02, gt=0.0, description='spread of the bias at start [rad/s]')
    bias_walk: float = Field(1e-4, gt=0.0, description='random walk of the bias [rad/s/sqrt(s)]')
    rest_time: float = Field(
        0.5,
        ge=0.0,
        description='initial time at rest whose average gives the bias; 0 to '
        'estimate it from the spread alone [s]',
    )
    rest_rate: float = Field(
        0.05, gt=0.0, description='scatter above which the start was no rest [rad/s]'
    )


class StrainSettings(Settings):
    """
    Strain factors: the two curvatures only.

    (theta, kappa) says nothing of the other components.
    """

    enabled: bool = True
    scale: float = Field(1.5, gt=0.0, description="factor on the datasheet's noise")
    cauchy: float = Field(4.0, gt=0.0, description='scale of the Cauchy loss in sigmas')


class TrackerSettings(Settings):
    """External pose factors."""

    enabled: bool = True
    sigma_position: float = Field(0.001, gt=0.0, description='where the message states none [m]')
    sigma_rotation_deg: float = Field(
        1.0, gt=0.0, description='where the message states none [deg]'
    )
    cauchy: float = Field(4.0, gt=0.0, description='scale of the Cauchy loss in sigmas')


class BaseSettings(Settings):
    """Measured pose of a carried base."""

    enabled: bool = True
    cauchy: float = Field(4.0, gt=0.0, description='scale of the Cauchy loss in sigmas')


class GravitySettings(Settings):
    """Accelerometer as gravity's direction, while the motion is quasi-static."""

    enabled: bool = False
    sigma: float = Field(
        0.3, gt=0.0, description="noise with the motion's own acceleration [m/s^2]"
    )
    gate: float = Field(
        0.5, gt=0.0, description='a specific force farther from g is not used [m/s^2]'
    )
    up: tuple[float, float, float] = Field(
        (0.0, 0.0, 1.0), description='direction against gravity in `map`'
    )


class FieldSettings(Settings):
    """Hall sensors in the field of the magnet at the base."""

    enabled: bool = True
    scale: float = Field(1.0, gt=0.0, description="factor on the datasheet's noise")
    share: float = Field(
        0.005, ge=0.0, description='share of the field that counts as noise: magnet, mounts, model'
    )
    cauchy: float = Field(10.0, gt=0.0, description='scale of the Cauchy loss in sigmas')
    earth: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="Earth's field in `map` [T]"
    )


class MechanicsSettings(Settings):
    """The shape that statics expects of the tendons, where the description has `actuation`."""

    enabled: bool = True
    scale: float = Field(1.0, gt=0.0, description="factor on the block's `strain_sigma`")
    memory: float = Field(
        0.3, gt=0.0, description='time over which all samples count as one observation [s]'
    )
    period: float = Field(
        0.05, ge=0.0, description='least time between two samples that are used [s]'
    )
    cauchy: float = Field(
        1.0,
        gt=0.0,
        description='scale of the Cauchy loss in sigmas: what touches something counts little',
    )
    loads: bool = Field(True, description='whether forces are looked for')
    load_period: float = Field(0.1, ge=0.0, description='least time between two looks [s]')
    load_evidence: float = Field(
        15.0, gt=0.0, description='by how much a force has to lower the misfit to be told (chi2)'
    )
    least_force: float = Field(0.2, ge=0.0, description='a weaker force is not told [N]')


class SolverSettings(Settings):
    """Gauss-Newton with damping."""

    max_iterations: int = Field(4, ge=1, description='per step while tracking')
    acquisition_iterations: int = Field(
        40, ge=1, description='per step before the first fit and when lost'
    )
    tolerance: float = Field(
        2e-4, gt=0.0, description='a smaller move of every pose ends the step [m, rad]'
    )
    relinearise: float = Field(
        1e-3, gt=0.0, description='a knot column that moved farther is linearised anew [m, rad]'
    )


class RecoverySettings(Settings):
    """Noticing that the filter is lost, and finding back."""

    enabled: bool = True
    suspect_share: float = Field(
        0.9,
        ge=0.0,
        le=1.0,
        description='share of fitting zones on the worst ring below which the body is suspect',
    )
    patience: float = Field(
        0.3, ge=0.0, description='time that a suspicion must last before a search [s]'
    )
    max_curvature: float = Field(
        1.5, gt=0.0, description='greatest curvature that the search tries [1/m]'
    )
    curvature_step: float = Field(
        0.25, gt=0.0, description="step of the search's curvatures [1/m]"
    )
    beam: int = Field(24, ge=1, description='partial bodies that the search keeps at each ring')
    distinct: float = Field(
        0.02, ge=0.0, description='least distance between two kept partial bodies [m]'
    )
    refined: int = Field(
        6, ge=1, description='how many of the best bodies are refined by the filter itself'
    )
    score_gate: float = Field(
        0.3, gt=0.0, description='farthest map point that a zone may match in the search [m]'
    )
    score_floor: float = Field(
        0.03, gt=0.0, description="noise that stands for the search's coarseness [m]"
    )
    margin: float = Field(
        0.1, ge=0.0, description="share by which another body's cost must be lower to be taken"
    )
    lost_sigma: tuple[float, float] = Field(
        (0.1, 0.3),
        description="spread added to the tip's pose while lost, less "
        'towards the base and while in doubt [m, rad]',
    )


class HealthSettings(Settings):
    """Which sensors are suspect."""

    sensor_share: float = Field(
        0.7,
        ge=0.0,
        le=1.0,
        description='share of fitting samples below which one sensor '
        'among healthy ones is suspect',
    )
    silence: float = Field(
        0.5, gt=0.0, description='time without a usable sample that makes a sensor suspect [s]'
    )
    suspect_weight: float = Field(
        0.05, gt=0.0, le=1.0, description='weight of a suspect ToF sensor or gyro'
    )
    flicker_share: float = Field(
        0.15,
        gt=0.0,
        le=1.0,
        description='share of zones that match the map in one frame and not in the next, above '
        'which a ToF sensor is noisy',
    )
    clock_offset: float = Field(
        0.025, gt=0.0, description='least offset of a clock that is told [s]'
    )
    clock_sigmas: float = Field(
        5.0, gt=0.0, description='how many standard deviations it must be from none'
    )
    clock_start: float = Field(
        1.0,
        ge=0.0,
        description='data before the first test of the clocks: the body still finds its place [s]',
    )
    clock_period: float = Field(
        0.4, ge=0.0, description='time between two tests of the clocks; 0 switches them off [s]'
    )


class DoubtSettings(Settings):
    """When the filter doubts what it is told, and itself."""

    enabled: bool = Field(True, description='whether causes are looked for')
    period: float = Field(
        0.4, gt=0.0, description='time between two comparisons of units, axes and signs [s]'
    )
    uneasy: float = Field(
        1.5,
        gt=0.0,
        description='mean normalised square beyond which an explanation is looked for',
    )
    patience: float = Field(0.3, ge=0.0, description='time that this must last [s]')
    consistency: float = Field(
        3.0, gt=0.0, description='mean normalised square beyond which an estimate is doubtful'
    )


class CalibrationSettings(Settings):
    """Estimating what the robot departs from its description by, within its tolerances."""

    enabled: bool = Field(
        True, description='whether constants of the robot are taken for uncertain at all'
    )
    online: bool = Field(
        True,
        description='whether they are estimated while it moves; else they only spread the '
        'covariance, as befits a robot that was calibrated',
    )
    period: float = Field(
        1.0, gt=0.0, description='time between two changes of what measurements are taken for [s]'
    )
    drift: float = Field(
        3600.0,
        gt=0.0,
        description='time in which a constant may wander off by its tolerance: a mount that is '
        'knocked, a sensor that warms up [s]',
    )
    least: float = Field(
        0.5,
        ge=0.0,
        le=1.0,
        description='share of its tolerance down to which a constant can be known: what the model '
        'misses does not average out',
    )


class EstimatorSettings(Settings):
    """The sliding-window filter."""

    knot_period: float = Field(0.1, gt=0.0, description='time between knots [s]')
    window: float = Field(1.0, gt=0.0, description='duration of the sliding window [s]')
    lag: float = Field(
        0.3, ge=0.0, description='age of the smoothed output; at most the window [s]'
    )
    output_rate: float = Field(
        15.0, gt=0.0, description='steps per second of data without ToF sensors to set the pace'
    )
    node_spacing: float = Field(
        0.16, gt=0.0, description='greatest distance between nodes on the backbone [m]'
    )
    history: float = Field(
        60.0, ge=0.0, description='time behind the window that queries reach [s]'
    )
    calibration_sigma: tuple[float, float] = Field(
        (0.0, 0.0),
        description="spread that mounting errors leave on each ring's pose, which no averaging "
        'removes; added to the published covariance [m, rad]',
    )
    backbone_points: int = Field(61, ge=2, description='poses of the published backbone')
    prior: PriorSettings = PriorSettings()
    tof: TofSettings = TofSettings()
    gyro: GyroSettings = GyroSettings()
    strain: StrainSettings = StrainSettings()
    tracker: TrackerSettings = TrackerSettings()
    base: BaseSettings = BaseSettings()
    gravity: GravitySettings = GravitySettings()
    field: FieldSettings = FieldSettings()
    mechanics: MechanicsSettings = MechanicsSettings()
    solver: SolverSettings = SolverSettings()
    recovery: RecoverySettings = RecoverySettings()
    health: HealthSettings = HealthSettings()
    doubts: DoubtSettings = DoubtSettings()
    calibration: CalibrationSettings = CalibrationSettings()


def settings_of(robot_name: str, given: str | Path | None = None) -> EstimatorSettings:
    """
    Choose the settings to use for a robot.

    Those `given` by name or file, else the preset of the robot's name, else the defaults, for a
    robot of your own.
    """
    if given:
        return load_estimator_settings(given)
    known = (PRESETS_FOLDER / f'{robot_name}.yaml').is_file()
    return load_estimator_settings(robot_name) if known else EstimatorSettings()


def load_estimator_settings(name_or_path: str | Path) -> EstimatorSettings:
    """
    Load settings from a YAML file, or the package's own by the robot's name.

    The package has `engine` and `soft_arm`.
    """
    return load_bundled(EstimatorSettings, PRESETS_FOLDER, name_or_path, 'estimator settings')
