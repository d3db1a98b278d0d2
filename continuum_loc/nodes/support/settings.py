"""
The parameters of each node.

Names, defaults, limits and descriptions are here and nowhere else.
"""

from __future__ import annotations

from typing import Literal

from continuum_loc.intake import IntakeSettings
from continuum_loc.settings import live, Settings
from pydantic import Field


class NodeSettings(Settings):
    """What every node has."""

    autostart: bool = Field(
        True,
        description='configure and activate by itself; false waits for a manager of lifecycles',
    )


class EstimatorNodeSettings(NodeSettings):
    """Node `estimator`."""

    robot: str = Field('engine', description='robot description: a bundled name or a YAML file')
    map: str = live(  # noqa: A003  (a parameter's public name)
        '', description='prior map: npz, a cloud or a mesh (see docs/files.md); empty for none'
    )
    settings: str = Field(
        '',
        description="filter settings: a bundled name or a YAML file; empty for the robot's "
        'own, or else the defaults',
    )
    frame_prefix: str = Field(
        '', description='put before every frame name except `map_frame` (several robots)'
    )
    tf: Literal['base', 'odom', 'rings', 'none'] = Field(
        'base',
        description='what is published on /tf, where tf2_msgs is installed: map -> base -> rings; '
        'map -> odom and base -> rings, where others move the base in `odom`; base -> rings '
        'alone; or nothing, on /tf_static neither',
    )
    map_frame: str = Field(
        'map', min_length=1, description="name of the prior map's frame, without a prefix"
    )
    odom_frame: str = Field(
        'odom', min_length=1, description='name of the frame in which others move the base'
    )
    base_frame: str = Field('base_link', min_length=1, description="name of the base's frame")
    base_tf: str = Field(
        '',
        description='frame on /tf that carries the base: where it is in the `frame` of the robot '
        "description's base.measurement goes out on `base/pose`, and is heard there; empty: none",
    )
    map_points: int = Field(
        100_000, ge=0, description='most points of the published `prior_map`; 0 for all'
    )
    reconstruction_seconds: float = live(
        3.0,
        ge=0.0,
        description='age up to which ToF points stay in `reconstruction`; 0 publishes none [s]',
    )
    reconstruction_rate: float = Field(
        1.0, gt=0.0, le=15.0, description='`reconstruction` messages per second [Hz]'
    )
    trajectory_seconds: float = Field(
        600.0,
        gt=0.0,
        description='how much of the newest trajectory is kept for ~/save_trajectory [s]',
    )
    output_folder: str = live(
        'runs/saved', description='where ~/save_map and ~/save_trajectory write'
    )
    diagnostics_rate: float = Field(
        1.0, gt=0.0, le=50.0, description='/diagnostics messages per second [Hz]'
    )
    lag_warning: float = live(
        0.1, gt=0.0, description='delay from reception to estimate that is a warning [s]'
    )
    summary_file: str = Field(
        '', description='JSON file of counts and latencies, written at the end; empty for none'
    )
    warm_up: bool = Field(
        True, description='compile all kernels before the first message is taken'
    )
    intake: IntakeSettings = IntakeSettings()


class ShapeNodeSettings(NodeSettings):
    """Node `shape`."""

    robot: str = Field('hall_arm', description='robot description: a bundled name or a YAML file')
    settings: str = Field('', description='shape settings YAML; empty for the defaults')
    frame_prefix: str = Field(
        '', description='put before every frame name except `map` (several robots)'
    )
    diagnostics_rate: float = Field(
        1.0, gt=0.0, le=50.0, description='/diagnostics messages per second [Hz]'
    )
    lag_warning: float = live(
        0.1, gt=0.0, description='delay from reception to estimate that is a warning [s]'
    )
    summary_file: str = Field(
        '', description='JSON file of counts and latencies, written at the end; empty for none'
    )
    intake: IntakeSettings = IntakeSettings()


class SimulatorNodeSettings(NodeSettings):
    """Node `simulator`."""

    robot: str = Field('engine', description='robot description: a bundled name or a YAML file')
    plant: str = Field(
        '', description="plant: a bundled name or a YAML file; empty for the robot's own"
    )
    scene: str = Field('S0', description='scene: S0-S9, R0-R4, a mesh file, or `none`')
    trajectory: str = Field('t1', description='name of the trajectory')
    profile: Literal['live', 'full'] = Field('live', description='how finely the body is modelled')
    tof_fidelity: Literal['paper', 'vl53l5cx'] = Field(
        'paper', description='how the ToF sensors are modelled'
    )
    world: str = Field(
        'ideal',
        description='`ideal`, `disturbed`, `disturbed:part+part`, or a file of true departures '
        'from the descriptions',
    )
    seed: int = Field(0, ge=0, description='seed of all noise')
    duration: float = Field(
        0.0, ge=0.0, description="data time after which the node ends; 0 for the trajectory's [s]"
    )
    frame_prefix: str = Field(
        '', description='put before every frame name except `map` (several robots)'
    )
    publish_truth: bool = live(True, description='publish `ground_truth/poses`')
    lookahead: float = Field(
        0.2, ge=0.0, le=5.0, description='how far the simulation may run ahead of the clock [s]'
    )
    behind_warning: float = live(
        0.02, gt=0.0, description='a delay behind the clock that is a warning [s]'
    )
    wait_for: int = Field(
        0, ge=0, description='start when this many subscriptions listen to the sensors'
    )
    wait_timeout: float = Field(120.0, gt=0.0, description='give up waiting after this time [s]')
    diagnostics_rate: float = Field(
        1.0, gt=0.0, le=50.0, description='/diagnostics messages per second [Hz]'
    )
    summary_file: str = Field(
        '', description='JSON file of counts and delays, written at the end; empty for none'
    )


class RecorderNodeSettings(NodeSettings):
    """Node `recorder`."""

    bag: str = Field('', description='folder of the new bag; empty for bag_<date>_<time>')
    topics: tuple[str, ...] = Field(
        ('all',), description='relative topics to record, or `all` of the contract'
    )
    reliable_inputs: bool = Field(
        False,
        description='ask publishers to resend lost messages; '
        'best-effort publishers are then not heard',
    )
    summary_file: str = Field(
        '', description='JSON file of message counts, written at the end; empty for none'
    )
    largest_message: int = Field(
        32_000_000, ge=1_000, description='a longer message is dropped [bytes]'
    )
    queue_messages: int = Field(
        100_000, ge=100, description='most messages that wait to be written; others are dropped'
    )
    queue_bytes: int = Field(
        256_000_000, ge=1_000_000, description='most bytes that wait to be written'
    )


class ReplayerNodeSettings(NodeSettings):
    """Node `replayer`."""

    bag: str = Field('', description='bag folder or .mcap file')
    namespace_in_bag: str = Field(
        '', description='whose topics, where the bag holds several robots'
    )
    topics: tuple[str, ...] = Field(
        ('inputs',),
        description='relative topics to publish; `inputs` are the sensors, trackers and truth',
    )
    rate: float = Field(1.0, gt=0.0, le=100.0, description='speed relative to the recording')
    loop: bool = Field(False, description='start again at the end')
    clock: bool = Field(True, description='publish /clock, for nodes with use_sim_time')
    clock_rate: float = Field(
        100.0, gt=0.0, le=1000.0, description='/clock messages per second of data [Hz]'
    )
    wait_for: int = Field(
        0, ge=0, description='start when this many subscriptions listen to the sensors'
    )
    wait_timeout: float = Field(60.0, gt=0.0, description='give up waiting after this time [s]')


class DriverNodeSettings(NodeSettings):
    """Node `driver`."""

    robot: str = Field('engine', description='robot description: a bundled name or a YAML file')
    source: str = Field(
        '-', description='serial port, pipe or file of JSON lines; - is the standard input'
    )
    frame_prefix: str = Field(
        '', description='put before every frame name except `map` (several robots)'
    )
    delay: float = live(
        0.0, ge=0.0, description='age of a reading without a stamp of its own when it comes [s]'
    )
    gyro_mdps_per_lsb: float = Field(
        17.5, gt=0.0, description="the gyro's sensitivity; 17.5 at +-500 dps [mdps/LSB]"
    )
    accel_mg_per_lsb: float = Field(
        0.122, gt=0.0, description="the accelerometer's sensitivity; 0.122 at +-4 g [mg/LSB]"
    )
    core_azimuth_deg: tuple[float, ...] = Field(
        (0.0, 120.0, 240.0),
        description="where the fibre's outer cores lie, from body y to z [deg]",
    )
    core_radius: float = Field(
        35e-6, gt=0.0, description="distance of the outer cores from the fibre's axis [m]"
    )
    longest_line: int = Field(65_536, ge=256, description='a longer line is refused [bytes]')


class ViewerNodeSettings(NodeSettings):
    """Node `viewer`."""

    host: str = Field(
        '127.0.0.1', description='address to serve on; 0.0.0.0 lets other machines watch'
    )
    port: int = Field(8765, ge=0, le=65535, description='port to serve on; 0 takes a free one')
    map_points: int = Field(
        20_000, ge=0, le=500_000, description='most map points that are sent to the browser'
    )
    cloud_points: int = Field(
        5_000,
        ge=0,
        le=100_000,
        description='most points of anything else that are sent to the browser',
    )
    largest_message: int = Field(
        32_000_000, ge=1_000, description='a longer message is not shown [bytes]'
    )
