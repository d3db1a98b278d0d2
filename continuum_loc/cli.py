"""
The command line `continuum-loc`.

Each command reads its arguments and calls the library; work is done there. It imports what it
needs itself, so that `--help` takes a tenth of a second.

Exit codes: 0 done, 1 a claim or a comparison failed, 2 wrong usage or input, or input of which
nothing, or no measurement of a whole kind of sensor, could be used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
import json
import os
from pathlib import Path
import shutil
import sys
from typing import Annotated, Any, TYPE_CHECKING

from continuum_loc.errors import (
    CalibrationError,
    ContinuumLocError,
    InputError,
    MapError,
    NotInstalled,
    StudyError,
)
from continuum_loc.extras import explained
from rich.console import Console
from rich.markup import escape
import typer

if TYPE_CHECKING:
    from continuum_loc.offline.claims import Claim
    from continuum_loc.offline.tune import Trying

OK, FAILED, USAGE = 0, 1, 2
CORES = len(os.sched_getaffinity(0))  # that this process may use

app = typer.Typer(
    name='continuum-loc',
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode='markdown',
    pretty_exceptions_enable=False,
    help='Online localisation and shape of continuum robots.',
)
map_app = typer.Typer(
    no_args_is_help=True,
    help='Build, convert and inspect prior maps.',
    rich_markup_mode='markdown',
)
app.add_typer(map_app, name='map')
robot_app = typer.Typer(
    no_args_is_help=True,
    help='Use robot descriptions elsewhere.',
    rich_markup_mode='markdown',
)
app.add_typer(robot_app, name='robot')
console = Console()
errors = Console(stderr=True)

Robot = Annotated[
    str, typer.Option(help='`engine`, `soft_arm`, `hall_arm`, or your own description (YAML)')
]
Scene = Annotated[
    str, typer.Option(help='`S0`-`S9`, `R0`-`R4`, or your own mesh (STL, OBJ, PLY; metres)')
]
MapFile = Annotated[Path | None, typer.Option('--map', help='prior map: .npz, a cloud or a mesh')]
Seed = Annotated[int, typer.Option(help='seed of everything random')]
Runs = Annotated[Path, typer.Option('--out', help='folder of the numbered runs')]
Settings = Annotated[
    Path | None, typer.Option(help='estimator settings (YAML); default: those of the robot')
]
Namespace = Annotated[
    str, typer.Option(help='whose topics, where the bag holds several robots; `/` for none')
]
Prefix = Annotated[str, typer.Option(help="what stands before the robot's frame names in the bag")]
Strict = Annotated[bool, typer.Option('--strict', help='end at the first unusable message')]


def main() -> None:
    """
    Entry point of the command.

    Errors of our own are told in one line, anything else is a bug and keeps its traceback.
    """
    try:
        app()
    except ContinuumLocError as error:
        _complain(error)
    except ModuleNotFoundError as error:
        told = explained(error)
        if told is error:
            raise
        _complain(told)


def _complain(error: ContinuumLocError) -> None:
    """Say what went wrong in one line, and end."""
    errors.print(f'[bold red]error:[/] {escape(str(error))}', highlight=False, soft_wrap=True)
    sys.exit(USAGE if isinstance(error, InputError) else FAILED)


@app.command()
def demo(
    robot: Robot = 'engine',
    scene: Scene = 'S0',
    trajectory: Annotated[str, typer.Option(help='named motion of the robot')] = 't1',
    duration: Annotated[float, typer.Option(help='seconds of live running', min=2.0)] = 20.0,
    seed: Seed = 0,
    out: Runs = Path('runs'),
) -> None:
    """
    Simulate and estimate live over ROS 2 into a bag and a report, and once more from the bag.

    Example: `continuum-loc demo --trajectory t2 --duration 10`
    """
    from continuum_loc.offline.demo import run_demo
    from continuum_loc.offline.trials import Trial

    with _busy() as status:
        outcome = run_demo(
            Trial(robot, scene, trajectory, seed=seed, duration=duration), out, status.update
        )
    unusable = _tell(outcome.folder, outcome.summary)
    console.print(f'bag     {outcome.bag}')
    for claim in outcome.claims:
        if not claim.holds:  # a slow machine is no failure of the demo; two different replays are
            errors.print(
                f'[yellow]missed:[/] {claim.name} {claim.value:.3g} {claim.unit} '
                f'(bound {claim.bound})',
                highlight=False,
            )
    if not outcome.identical:
        raise typer.Exit(FAILED)
    console.print(
        'replay  two replays of the bag without ROS gave the same estimate, to the last bit'
    )
    raise typer.Exit(USAGE if unusable else OK)


@app.command()
def simulate(
    bag: Annotated[Path, typer.Argument(help='new bag folder to write')],
    robot: Robot = 'engine',
    scene: Scene = 'S0',
    trajectory: Annotated[
        str, typer.Option(help='named motion of the robot, or your own (YAML)')
    ] = 't1',
    plant: Annotated[
        str | None,
        typer.Option(
            help="stiffness, mass, tendons: bundled name or your own (YAML); default: the robot's"
        ),
    ] = None,
    profile: Annotated[
        str, typer.Option(help="`full`: the paper's fine links; `live`: fewer")
    ] = 'full',
    fidelity: Annotated[str, typer.Option(help='ToF model: `paper` or `vl53l5cx`')] = 'paper',
    world_name: Annotated[
        str,
        typer.Option(
            '--world',
            help='`ideal`, `disturbed`, or true departures of your own (YAML); '
            '`disturbed:mounts+base` takes parts alone',
        ),
    ] = 'ideal',
    carried: Annotated[
        str,
        typer.Option(
            help='what carries the base: `smooth`, `brisk`, `stops`, `wrist`, or your own (YAML)'
        ),
    ] = '',
    told: Annotated[
        str, typer.Option(help='how that tells where the base is: `arm` or `odometry`')
    ] = 'arm',
    duration: Annotated[
        float | None, typer.Option(help='seconds; default: the whole trajectory')
    ] = None,
    seed: Annotated[int, typer.Option(help='seed of everything random', min=0)] = 0,
) -> None:
    """
    Record a simulated trial, sensors and truth, into a bag (rosbag2, MCAP) as fast as it goes.

    Example: `continuum-loc simulate /tmp/trial --scene S3 --trajectory t2 --seed 4`
    """
    from continuum_loc.offline.trial_runs import trial_map_file
    from continuum_loc.offline.trials import Trial, world, write_bag

    trial = Trial(
        robot,
        scene,
        trajectory,
        plant=plant,
        profile=profile,
        fidelity=fidelity,
        seed=seed,
        duration=duration,
        world=world_name,
        carried=carried,
        told=told,
    )
    with _busy() as status:
        status.update('building the scene and letting the robot come to rest')
        made = world(trial)
    seconds = made.trajectory.duration if duration is None else duration
    counts = write_bag(bag, _progress(made.run(duration), 'simulating', seconds))
    _count_table(counts, f'{bag}: {seconds:g} s')
    if made.scene is not None and trial.departures.map_departs:
        prior_map = bag.with_name(f'{bag.name}_map.npz')
        shutil.copyfile(trial_map_file(trial), prior_map)
        console.print(f'prior map as it was scanned: {prior_map}', highlight=False)


@app.command('import-trial')
def import_trial_command(
    folder: Annotated[Path, typer.Argument(help="folder of one recorded trial's CSV files")],
    bag: Annotated[Path, typer.Argument(help='new bag folder to write')],
    robot: Annotated[str, typer.Option(help='which sensor sits where')] = 'tendon_robot',
) -> None:
    """
    Write a recorded trial of the tendon-driven robot, measurements and truth, into a bag.

    Example: `continuum-loc import-trial slow_free_space /tmp/slow`
    """
    from continuum_loc.robot import load_robot

    require_research()
    from studies.support.tendon_robot import import_trial

    _count_table(import_trial(folder, bag, load_robot(robot)), str(bag))


@app.command()
def replay(
    bag: Annotated[Path, typer.Argument(help='bag folder, or .mcap or .db3 file')],
    robot: Robot = 'engine',
    map_file: MapFile = None,
    scene: Annotated[
        str | None,
        typer.Option(help='scene that is shown in the report, and whose map replaces `--map`'),
    ] = None,
    settings: Settings = None,
    namespace: Namespace = '',
    frame_prefix: Prefix = '',
    strict: Strict = False,
    seed: Seed = 0,
    out: Runs = Path('runs'),
) -> None:
    """
    Localise from a recorded bag without a ROS graph.

    The same bag gives the same estimate, bit for bit. What cannot be used of it is counted and
    told at the end, and the rest is used.

    Example: `continuum-loc replay runs/latest/bag --map my_map.ply --robot my_robot.yaml`
    """
    from continuum_loc.estimator import settings_of
    from continuum_loc.mapping.scale import map_for
    from continuum_loc.offline.localise import make_filter
    from continuum_loc.offline.replay import replay as run_replay
    from continuum_loc.offline.runs import new_run, save_run
    from continuum_loc.offline.scene_maps import scene_map_file
    from continuum_loc.robot import load_robot

    description = load_robot(robot)
    chosen = settings_of(description.name, settings)
    if description.tof and chosen.tof.enabled:
        _require_map(description.name, map_file, scene)
    with _busy() as status:
        status.update('loading the prior map')
        if map_file is None and scene is not None:
            map_file = scene_map_file(scene)
        prior = None if map_file is None else map_for(description, map_file)
        estimator = make_filter(description, prior, chosen)
    if prior is not None:
        _say(map_file, prior.notes)
    with _bar('replaying', _bag_duration(bag)) as progress:
        result = run_replay(
            bag,
            estimator,
            namespace=namespace,
            frame_prefix=frame_prefix,
            strict=strict,
            progress=progress,
        )
    used = {} if map_file is None else {'file': map_file}
    configuration = {'robot': description, 'bag': bag, 'map': used, 'scene': scene}
    configuration['estimator'] = estimator.settings
    folder = new_run('replay', out)
    summary = save_run(folder, result, kind='replay', seed=seed, configuration=configuration)
    raise typer.Exit(USAGE if _tell(folder, summary) else OK)


@app.command()
def check(
    bag: Annotated[
        Path | None, typer.Argument(help='bag folder or file; without one the running graph')
    ] = None,
    robot: Robot = 'engine',
    map_file: MapFile = None,
    settings: Settings = None,
    namespace: Namespace = '',
    frame_prefix: Prefix = '',
    seconds: Annotated[
        float, typer.Option(help='how long to listen to a running graph', min=2.0)
    ] = 10.0,
) -> None:
    """
    Check a running graph, or a bag, against the robot description and the map.

    Topics, rates, clocks, frames, units, and mounts as far as the map tells. The exit code is 1
    where something is wrong.

    Example: `continuum-loc check --robot my_robot.yaml --map my_map.ply`
    """
    from tempfile import TemporaryDirectory

    from continuum_loc.estimator import settings_of
    from continuum_loc.mapping.scale import map_for
    from continuum_loc.offline.check import check_bag
    from continuum_loc.offline.localise import make_filter
    from continuum_loc.robot import load_robot

    description = load_robot(robot)
    with TemporaryDirectory() as folder, _busy() as status:
        if bag is None:
            from continuum_loc.nodes.recorder import record_for

            status.update(f'listening for {seconds:g} s')
            bag = Path(folder) / 'heard'
            record_for(seconds, bag, namespace)
        status.update('checking')
        prior = None if map_file is None else map_for(description, map_file)
        chosen = settings_of(description.name, settings)
        estimator = make_filter(description, prior, chosen)
        findings = check_bag(bag, estimator, namespace, frame_prefix)
    colours = {'ok': 'green', 'warning': 'yellow', 'error': 'bold red'}
    for one in findings:
        said = f'[{colours[one.level]}]{one.level:8}[/] {escape(one.matter)}: {escape(one.text)}'
        console.print(said, highlight=False, soft_wrap=True)
    raise typer.Exit(FAILED if any(one.level == 'error' for one in findings) else OK)


@app.command()
def shape(
    bag: Annotated[Path, typer.Argument(help='bag folder, or .mcap or .db3 file')],
    robot: Robot = 'hall_arm',
    settings: Annotated[
        Path | None, typer.Option(help="shape settings (YAML); default: the package's")
    ] = None,
    namespace: Namespace = '',
    frame_prefix: Prefix = '',
    strict: Strict = False,
    out: Runs = Path('runs'),
) -> None:
    """
    Estimate the shape from Hall sensors and IMUs of a recorded bag.

    The robot rests while it begins.

    Example: `continuum-loc shape bench_top.mcap --robot my_arm.yaml`
    """
    from continuum_loc.offline.replay import replay as run_replay
    from continuum_loc.offline.runs import new_run, save_run
    from continuum_loc.offline.shape_replay import ShapeReplay
    from continuum_loc.robot import load_robot
    from continuum_loc.shape import load_shape_settings

    description = load_robot(robot)
    estimator = ShapeReplay(description, load_shape_settings(settings))
    with _bar('estimating', _bag_duration(bag)) as progress:
        result = run_replay(
            bag,
            estimator,
            namespace=namespace,
            frame_prefix=frame_prefix,
            strict=strict,
            progress=progress,
        )
    configuration = {'robot': description, 'bag': bag, 'estimator': estimator.settings}
    folder = new_run('shape', out)
    summary = save_run(folder, result, kind='shape', seed=None, configuration=configuration)
    raise typer.Exit(USAGE if _tell(folder, summary) else OK)


@app.command()
def repair(
    bag: Annotated[Path, typer.Argument(help='bag folder or file that cannot be read')],
    out: Annotated[
        Path | None, typer.Argument(help='new bag folder; default: `BAG_repaired`')
    ] = None,
) -> None:
    """
    Save what is whole of a bag that was cut off: its recorder was killed, or its disk was full.

    The bag itself stays as it is.

    Example: `continuum-loc repair bag_20260101_120000`
    """
    from continuum_loc.offline.repair import repair as save_whole

    out = out or bag.with_name(f'{bag.stem if bag.is_file() else bag.name}_repaired')
    with _busy() as status:
        status.update('reading what is whole')
        done = save_whole(bag, out)
    _count_table(done.saved, '')
    said = f'{out}: {done.saved.total():,} messages over {done.seconds:.1f} s'
    for line in (said, *done.lost, 'what its recorder had not yet written is not in it'):
        console.print(line, highlight=False, soft_wrap=True)


def _require_map(robot: str, map_file: Path | None, scene: str | None) -> None:
    if map_file is None and scene is None:
        raise MapError(
            f"robot '{robot}' has ToF sensors, which need a prior map: give `--map FILE`, or "
            '`--scene NAME` for the map of a scene of the simulator'
        )


@app.command()
def tune(
    out: Annotated[Path, typer.Argument(help='settings file to write (YAML)')],
    robot: Robot = 'engine',
    bag: Annotated[
        Path | None,
        typer.Option(help="recorded hold-out with truth; default: the robot's own, simulated"),
    ] = None,
    map_file: MapFile = None,
    settings: Settings = None,
    jobs: Annotated[int, typer.Option(help='processes', min=1)] = 1,
) -> None:
    """
    Sweep process and measurement noise on a hold-out bag, and write what is best.

    It is judged by error and by consistency.

    Example: `continuum-loc tune my_settings.yaml --bag hold_out --map my_map.npz --jobs 2`
    """
    import tempfile

    from continuum_loc.estimator.settings import settings_of
    from continuum_loc.mapping.scale import map_for
    from continuum_loc.offline.scene_maps import scene_map_file
    from continuum_loc.offline.trials import simulate, write_bag
    from continuum_loc.offline.tune import FACTORS, hold_out, PARAMETERS
    from continuum_loc.offline.tune import tune as sweep
    from continuum_loc.robot import load_robot
    from continuum_loc.settings import dump_settings
    from rich.progress import Progress

    if bag is not None and map_file is None:
        raise MapError('a bag of your own needs the map of its place: give `--map FILE` too')
    description = load_robot(robot)
    start = settings_of(description.name, settings)
    if map_file is not None:
        _say(map_file, map_for(description, map_file).notes)
    with (
        tempfile.TemporaryDirectory() as scratch,
        Progress(console=errors, transient=True) as progress,
    ):
        if bag is None:
            bag = Path(scratch) / 'hold_out'
            progress.console.print(f'simulating the hold-out {hold_out(robot).recording}')
            write_bag(bag, simulate(hold_out(robot)))
        task = progress.add_task('sweeping', total=1 + len(PARAMETERS) * len(FACTORS))
        best, tried = sweep(
            bag,
            description,
            map_file or scene_map_file(hold_out(robot).scene),
            start,
            jobs,
            tell=lambda one: progress.advance(task),
        )
    dump_settings(best, out)
    _tell_sweep(tried[0], min(tried, key=lambda one: one.cost))
    console.print(f'written {out}')


@app.command()
def identify(
    recordings: Annotated[
        list[Path],
        typer.Argument(help='bags, or CSV tables of motors and tip positions, of one robot'),
    ],
    out: Annotated[Path, typer.Option(help='description to write (YAML)')],
    robot: Robot = 'engine',
    arm: Annotated[
        float | None,
        typer.Option(help='distance of tendons from the backbone [m], where none are described'),
    ] = None,
    test: Annotated[
        list[Path] | None, typer.Option(help='recording that is only predicted, not fitted')
    ] = None,
) -> None:
    """
    Find which motor is which tendon, angles, offsets, stiffness, friction, and the tip's marker.

    Reads `joint_states` and the position of a tracker on the last ring, or the truth. The robot
    says its length and where its modules end; a block `actuation` that it has is the start.

    Example: `continuum-loc identify moves.csv --robot arm.yaml --arm 0.0045 --out found.yaml`
    """
    from continuum_loc.offline.identified import identify as run_identify
    from continuum_loc.offline.identified import predict, read_recording, rmse
    from continuum_loc.offline.motor_csv import together
    from continuum_loc.robot import load_robot
    from continuum_loc.settings import dump_settings

    description = load_robot(robot)
    recording = together([read_recording(path, description) for path in recordings])
    with _busy() as status:
        found = run_identify(description, recording, arm, status.update)
    dump_settings(found.robot, out)
    for name, value in found.figures().items():
        console.print(f'{name:34}{value:.2f}', highlight=False)
    for path in test or ():
        error, nees = predict(found.robot, read_recording(path, description))
        said = f'{path}: tip RMSE {rmse(error):.2f} mm, NEES/dof {nees.mean():.2f}'
        console.print(said, highlight=False, soft_wrap=True)
    for finding in found.findings:
        console.print(finding, highlight=False, soft_wrap=True)
    console.print(f'written {out}')


@app.command()
def calibrate(
    bags: Annotated[list[Path], typer.Argument(help='bags of one robot in one place')],
    out: Annotated[Path, typer.Option(help='description to write (YAML)')],
    robot: Robot = 'engine',
    map_file: Annotated[Path | None, typer.Option('--map', help='prior map')] = None,
    settings: Annotated[str, typer.Option(help="estimator's, by name or file")] = '',
    reference: Annotated[
        str, typer.Option(help='what tells where the rings were: none, tracker or truth')
    ] = 'none',
) -> None:
    """
    Find what a robot departs from its description by: mounts, ranges, gyros, clocks, base.

    The description's `tolerances` say how far each may be off. Writes a new description, the
    covariance that is left, and a report that says what the bags do not show.

    Example: `continuum-loc calibrate runs/a --robot mine.yaml --map cell.npz --out found.yaml`
    """
    from continuum_loc.estimator.settings import settings_of
    from continuum_loc.mapping.map_files import load_map
    from continuum_loc.offline.calibrated import calibrate_bags, write_calibration
    from continuum_loc.robot import load_robot

    description = load_robot(robot)
    if description.tof and map_file is None:
        raise CalibrationError(
            f"robot '{description.name}' has ToF sensors, which tell nothing without a map: "
            'give the one of this place with --map'
        )
    chosen = settings_of(description.name, settings or None)
    with _busy() as status:
        found = calibrate_bags(
            description,
            load_map(map_file) if map_file else None,
            bags,
            chosen,
            reference,
            lambda doing, done: status.update(f'{doing}: {done:.1f}'),
        )
    said = 'converged' if found.converged else 'not converged'
    console.print(
        f'{len(found.theta)} constants, {len(found.unseen())} of them hardly told; {said}',
        highlight=False,
    )
    for path in write_calibration(found, chosen.calibration.least, out):
        console.print(f'written {path}', highlight=False, soft_wrap=True)


def _tell_sweep(start: Trying, best: Trying) -> None:
    for name, one in (('start', start), ('best', best)):
        console.print(
            f'{name:6}{100 * one.translation_rmse_m:.3f} cm  {one.rotation_rmse_deg:.3f} deg  '
            f'NEES/dof {one.nees_per_dof:.2f}',
            highlight=False,
        )


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help='run folder')] = Path('runs/latest'),
    picture: Annotated[
        Path | None,
        typer.Option(
            help='also draw a still (PNG) and a moving picture (GIF): '
            'their path without the ending'
        ),
    ] = None,
) -> None:
    """
    Make the report of a run anew, from the files in its folder.

    Example: `continuum-loc report runs/0003-replay --picture docs/localising`
    """
    path = _write_report(run)
    console.print(f'report  {path}')
    if picture is not None:
        from continuum_loc.offline.pictures import draw

        with _busy() as status:
            status.update('drawing')
            for made in draw(run, picture):
                console.print(f'picture {made}')


@app.command()
def evaluate(
    name: Annotated[
        str | None,
        typer.Argument(
            help='study; without one they are listed; `bags` for recordings of your own'
        ),
    ] = None,
    folder: Annotated[
        Path | None, typer.Argument(help='with `bags`: the folder that holds them')
    ] = None,
    quick: Annotated[
        bool, typer.Option('--quick', help='a small honest subset, under a minute')
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help='folder of the results; default: a new run')
    ] = None,
    seed: Seed = 0,
    jobs: Annotated[int, typer.Option(help='processes; one for each core', min=1)] = CORES,
    minutes: Annotated[
        float | None, typer.Option(help='with `soak`: how long, instead of half an hour', min=0.5)
    ] = None,
    worlds: Annotated[
        list[str] | None,
        typer.Option('--world', help='`ideal` or `disturbed` alone; studies print both'),
    ] = None,
    scheduler: Annotated[str, typer.Option(help='Dask scheduler that runs the trials')] = '',
    robot: Annotated[str, typer.Option(help='with `bags`: the robot')] = 'engine',
    map_file: Annotated[
        Path | None, typer.Option('--map', help='with `bags`: the prior map')
    ] = None,
    settings: Settings = None,
) -> None:
    """
    Run a study and compare its figures with their bounds.

    The exit code is 1 where one does not hold.

    An interrupted study continues where it stopped when its `--out` is given again.

    Example: `continuum-loc evaluate table2 --quick`, `continuum-loc evaluate bags my_bags
    --map my_map.npz`
    """
    from continuum_loc.offline.parallel import SCHEDULER
    from continuum_loc.offline.runs import new_run

    if name is None:
        _list_studies()
        return
    _check_study_options(name, folder, map_file, minutes)
    run = None if name == 'bags' else _study(name)
    out = out or new_run(name)
    out.mkdir(parents=True, exist_ok=True)
    SCHEDULER.set(scheduler)
    _choose_worlds(worlds or [])
    if run is None:
        claims = _evaluate_bags(folder, robot, map_file, settings, out, jobs)
    else:
        claims = _run_study(name, run, out, quick, seed, jobs, minutes)
    raise typer.Exit(_tell_claims(name, claims, out))


def _check_study_options(
    name: str, folder: Path | None, map_file: Path | None, minutes: float | None
) -> None:
    if name == 'bags' and (folder is None or map_file is None):
        raise typer.BadParameter('bags needs a folder and a map: evaluate bags DIR --map FILE')
    if minutes is not None and name != 'soak':
        raise typer.BadParameter('--minutes goes with soak')


def _list_studies() -> None:
    require_research()
    from studies import study_names

    console.print('studies: ' + ', '.join([*study_names(), 'bags DIR']))


def _tell_claims(name: str, claims: list[Claim], out: Path) -> int:
    """Print what a study claims and what it lost; the exit code."""
    console.print(_claims_table(claims))
    for trial, error in _failed(out, name).items():
        errors.print(f'[bold red]failed:[/] {escape(f"{trial}: {error}")}', highlight=False)
    console.print(f'results {out}')
    return OK if all(claim.holds for claim in claims) else FAILED


def _run_study(
    name: str,
    run: Any,
    out: Path,
    quick: bool,
    seed: int,
    jobs: int,
    minutes: float | None,
) -> list[Claim]:
    """Run a study; one that is reported is entered into the books, unless it is a quick run."""
    from studies import _books as books

    if minutes is not None:
        from studies.soak import soak

        return soak(out, 60.0 * minutes, seed)
    if quick:
        return run(out, quick, seed, jobs)
    books.require_book(name)
    claims = run(out, quick, seed, jobs)
    if books.enter(name, seed, claims):
        errors.print(
            f'[yellow]reported before with other numbers of the filter:[/] see {books.LOG}',
            highlight=False,
        )
    return claims


def _choose_worlds(names: list[str]) -> None:
    """Let studies run in these worlds alone, if there are any."""
    if not names:
        return
    require_research()
    from studies.support.worlds import WORLDS

    for name in names:
        if name not in WORLDS.get():
            raise typer.BadParameter(f"--world '{name}': give {' or '.join(WORLDS.get())}")
    WORLDS.set(tuple(dict.fromkeys(names)))


def _study(name: str) -> Any:
    require_research()
    from studies import load_study

    return load_study(name)


def require_research() -> None:
    """
    Make the studies and benchmarks of the source tree importable.

    Raises StudyError with what to do where only the package was installed.
    """
    tree = Path(__file__).parents[1]
    if not (tree / 'studies' / '__init__.py').is_file():
        raise StudyError(
            'studies and benchmarks stand in the source tree, which is not installed with the '
            'package: clone the repository, `make install` there, and use its .venv/bin/'
            'continuum-loc'
        )
    if str(tree) not in sys.path:
        sys.path.append(str(tree))


def _failed(out: Path, name: str) -> dict[str, str]:
    """Read the trials that a study lost, and why; some write to a folder of their name."""
    for summary in (out / name / 'summary.json', out / 'summary.json'):
        if summary.is_file():
            return json.loads(summary.read_text()).get('failed', {})
    return {}


def _evaluate_bags(
    folder: Path, robot: str, map_file: Path, settings: Path | None, out: Path, jobs: int
) -> list[Claim]:
    from continuum_loc.estimator.settings import settings_of
    from continuum_loc.mapping.scale import map_for
    from continuum_loc.offline.bags import evaluate_bags
    from continuum_loc.robot import load_robot

    description = load_robot(robot)
    _say(map_file, map_for(description, map_file).notes)
    return evaluate_bags(
        folder, description, map_file, settings_of(description.name, settings), out, jobs
    )


@app.command()
def bench(
    quick: Annotated[bool, typer.Option('--quick', help='few repeats, small sizes')] = False,
    out: Annotated[
        Path | None, typer.Option(help='folder of the results; default: a new run')
    ] = None,
    only: Annotated[str | None, typer.Option(help='one benchmark by name')] = None,
    check: Annotated[
        bool, typer.Option('--check', help='compare with the committed baseline')
    ] = False,
    baseline: Annotated[
        bool, typer.Option('--baseline', help='keep these ratios, and put them into docs/speed.md')
    ] = False,
    peers: Annotated[bool, typer.Option(help='install what we are compared with')] = True,
) -> None:
    """
    Measure everything a user waits for beside what they would use instead, as ratios with spread.

    Example: `continuum-loc bench --quick --only lookup`
    """
    require_research()
    from bench import harness as benches
    from continuum_loc.offline.runs import new_run

    names = benches.bench_names(only)
    if check:  # what would fail after the work fails before it
        benches.read_baseline()
    if baseline:
        benches.require_places(names)
    if peers:
        benches.install_peers()
    outcome = benches.run_bench(out or new_run('bench'), quick, only, _each)
    console.print(_text_table(benches.table(outcome.rows)))
    if outcome.claims:
        console.print(_claims_table(outcome.claims))
    for line in outcome.failures:
        errors.print(f'[bold red]failed:[/] {escape(line)}', highlight=False)
    if baseline:
        benches.write_baseline(outcome.rows, partial=only is not None or bool(outcome.failures))
        benches.write_document(outcome.rows)
    regressions = outcome.regressions() if check else []
    for line in regressions:
        errors.print(f'[bold red]slower than the baseline:[/] {escape(line)}', highlight=False)
    # Sizes and repeats of --quick prove no bound.
    held = all(claim.holds for claim in outcome.claims) or quick
    raise typer.Exit(OK if names and held and not (outcome.failures or regressions) else FAILED)


@map_app.command('build')
def map_build(
    scene: Annotated[str, typer.Argument(help='scene name or mesh file')],
    out: Annotated[Path, typer.Argument(help='file to write: .npz .ply .csv .xyz')],
    points: Annotated[int, typer.Option(help='about how many points', min=100)] = 300_000,
    spacing: Annotated[
        float | None, typer.Option(help='distance of the points [m]; instead of --points')
    ] = None,
    seed: Seed = 0,
) -> None:
    """
    Sample a prior map from a scene or from your own mesh.

    Example: `continuum-loc map build my_engine.stl my_map.npz --spacing 0.005`
    """
    from continuum_loc.mapping.build import sample_mesh
    from continuum_loc.simulator.scenes import load_scene

    with _busy() as status:
        status.update('sampling the surface')
        mesh = load_scene(scene)
        density = {'count': points} if spacing is None else {'spacing': spacing}
        prior = sample_mesh(mesh.vertices, mesh.faces, **density, seed=seed, source=scene)
        prior.save(out)
    _describe_map(out, prior)


@map_app.command('convert')
def map_convert(
    source: Annotated[Path, typer.Argument(help='cloud or mesh to read')],
    out: Annotated[Path, typer.Argument(help='file to write: .npz .ply .csv .xyz')],
    viewpoint: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help='a place that the surface is seen from, for clouds without normals'),
    ] = None,
    scale: Annotated[
        float, typer.Option(help='what lengths are multiplied by to be metres: 0.001 for mm')
    ] = 1.0,
    sigma: Annotated[
        float | None,
        typer.Option(help='standard deviation of a point [m]; default: what the file states'),
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help='distance of the points sampled from a mesh [m]')
    ] = None,
) -> None:
    """
    Read a map in any known form and write it in another.

    The standard deviation is kept in `.npz` alone.

    Example: `continuum-loc map convert scan.pcd map.npz --viewpoint 0 0 1 --sigma 0.002`
    """
    from continuum_loc.mapping.map_files import load_map

    prior = load_map(source, viewpoint=viewpoint, scale=scale, sigma=sigma, spacing=spacing)
    prior.save(out)
    _describe_map(out, prior)


@robot_app.command('urdf')
def robot_urdf(
    robot: Annotated[str, typer.Argument(help='a bundled robot, or a description (YAML)')],
    out: Annotated[
        Path | None, typer.Argument(help='file to write; printed where there is none')
    ] = None,
    base_frame: Annotated[str, typer.Option(help="name of the base's link")] = 'base_link',
) -> None:
    """
    Write a URDF of a robot description, for robot_state_publisher and RViz.

    Example: `continuum-loc robot urdf engine engine.urdf`
    """
    from continuum_loc.offline.urdf import urdf
    from continuum_loc.robot import load_robot

    text = urdf(load_robot(robot), base_frame)
    if out is None:
        sys.stdout.write(text)
    else:
        out.write_text(text)


@map_app.command('info')
def map_info(file: Annotated[Path, typer.Argument(help='map file')]) -> None:
    """
    Say what a map holds.

    Example: `continuum-loc map info map.npz`
    """
    from continuum_loc.mapping.map_files import load_map

    _describe_map(file, load_map(file))


def _describe_map(path: Path, prior: Any) -> None:
    from continuum_loc.mapping.scale import size_note

    low, high = prior.points.min(axis=0), prior.points.max(axis=0)
    box = ' x '.join(f'{a:.2f}..{b:.2f}' for a, b in zip(low, high, strict=True))
    console.print(
        f'{escape(str(path))}: {len(prior):,} points, {1e3 * prior.spacing:.1f} mm apart, '
        f'in {box} m, sigma {1e3 * prior.sigma:.3g} mm, '
        f'mean planarity {prior.planarity.mean():.2f}, '
        f'normals {"outward" if prior.oriented else "of either sign"}',
        highlight=False,
        soft_wrap=True,
    )
    _say(path, (*prior.notes, *size_note(prior)), console)


def _say(path: Path, notes: Iterable[str], to: Console = errors) -> None:
    """Print what there is to know about a file that was read."""
    for note in notes:
        to.print(f'[yellow]note:[/] {escape(f"{path}: {note}")}', highlight=False, soft_wrap=True)


def _write_report(folder: Path) -> Path:
    from continuum_loc.offline.report import context_of, write_report
    from continuum_loc.offline.runs import load_run

    with _busy() as status:
        status.update('writing the report')
        run = load_run(folder)
        return write_report(run, context_of(run))


def _tell(folder: Path, summary: dict[str, Any]) -> bool:
    """Say what a run gave, on one screen; whether nothing could be used of it, or of a sensor."""
    from continuum_loc.offline.account import account_lines

    if summary['poses']:
        console.print(_run_table(summary))
    else:
        estimates = summary['estimates']
        console.print(
            f'{estimates["all"]} estimates ({estimates["tracking"]} tracking, '
            f'{estimates["initialising"]} initialising, {estimates["lost"]} lost), none judged: '
            f'no truth; {_speed(summary)}',
            highlight=False,
        )
    for line in account_lines(summary['account']):
        style = 'bold red' if line.startswith('PROBLEM') else ''
        console.print(escape(line), style=style, highlight=False)
    _report_where_it_can(folder)
    return bool(summary['account']['problems'])


def _report_where_it_can(folder: Path) -> None:
    """Write the report of a run, which stands without it where its libraries are missing."""
    try:
        if not (folder / 'report.html').is_file():
            _write_report(folder)
    except NotInstalled as error:
        console.print(f'run     {folder}')
        said = f'[yellow]no report:[/] {escape(str(error))}'
        errors.print(said, highlight=False, soft_wrap=True)
        return
    console.print(
        f'report  [link=file://{folder.absolute()}/report.html]{folder}/report.html[/link]'
    )


def _run_table(summary: dict[str, Any]) -> Any:
    """Print the short table at the end of a run: one line per ring, then speed."""
    from rich.table import Table

    def cells(entry: dict[str, Any]) -> list[str]:
        return [
            _figure(entry['translation_mae_m'], 100),
            _figure(entry['translation_rmse_m'], 100),
            _figure(entry['rotation_mae_deg']),
            _figure(entry['rotation_rmse_deg']),
            _figure(entry['nees_per_dof']),
            _figure(entry['coverage_95'], 100),
        ]

    table = Table(caption=_speed(summary), caption_justify='left', show_edge=False)
    for name in ('', 'MAE cm', 'RMSE cm', 'MAE deg', 'RMSE deg', 'NEES/dof', 'in 95 %, %'):
        table.add_column(name, justify='right' if name else 'left')
    for ring, entry in summary['rings'].items():
        table.add_row(ring, *cells(entry))
    table.add_section()
    table.add_row('all rings', *cells(summary), style='bold')
    return table


def _speed(summary: dict[str, Any]) -> str:
    said = [
        f'real-time factor {_figure(summary["real_time_factor"])}',
        f'step p99 {_figure(summary["step_ms"]["p99"])} ms',
    ]
    if 'latency_ms' in summary:
        said.append(f'live latency p95 {_figure(summary["latency_ms"]["p95"])} ms')
    return ', '.join(said)


def _claims_table(claims: list[Claim]) -> Any:
    from rich.table import Table

    table = Table(show_edge=False)
    for name, justify in (
        ('claim', 'left'),
        ('value', 'right'),
        ('unit', 'left'),
        ('bound', 'left'),
        ('', 'left'),
    ):
        table.add_column(name, justify=justify)
    for claim in claims:
        verdict = '[green]holds[/]' if claim.holds else '[bold red]FAILS[/]'
        table.add_row(claim.name, f'{claim.value:.4g}', claim.unit, claim.bound, verdict)
    return table


def _text_table(rows: list[dict[str, str]]) -> Any:
    from rich.table import Table

    table = Table(*(rows[0] if rows else ()), show_edge=False)
    for row in rows:
        table.add_row(*(escape(str(cell)) for cell in row.values()))
    return table


def _count_table(counts: dict[str, int], title: str) -> None:
    from rich.table import Table

    table = Table('topic', 'messages', title=title, title_justify='left', show_edge=False)
    for topic, count in sorted(counts.items()):
        table.add_row(topic, f'{count:,}')
    console.print(table)


def _figure(value: float | None, scale: float = 1.0) -> str:
    return '-' if value is None else f'{scale * value:.2f}'


def _busy() -> Any:
    """Show a spinner whose text says what is going on."""
    return errors.status('')


@contextmanager
def _bar(label: str, seconds: float | None) -> Iterator[Callable[[float], None]]:
    """Show a bar; gives what is to be told the time of the data [s] that was reached."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        TextColumn('{task.completed:.1f} s'),
        TimeRemainingColumn(),
    )
    quiet = not errors.is_terminal  # a file gets no bar, and no empty line for one
    with Progress(*columns, console=errors, transient=True, disable=quiet) as progress:
        task, shown = progress.add_task(label, total=seconds), 0.0

        def tell(elapsed: float) -> None:
            nonlocal shown
            if elapsed - shown > 0.1:
                shown = elapsed
                progress.update(task, completed=shown)

        yield tell


def _progress(samples: Any, label: str, seconds: float | None) -> Any:
    """Pass samples on, with a bar over the time that their stamps span."""
    first = None
    with _bar(label, seconds) as tell:
        for sample in samples:
            first = sample.stamp if first is None else first
            tell((sample.stamp - first) * 1e-9)
            yield sample


def _each(items: list[Any], label: str) -> Any:
    """Pass items on, with a bar over their number."""
    from rich.progress import track

    return track(items, label, console=errors, transient=True)


def _bag_duration(bag: Path) -> float | None:
    from msg_tools.bag import open_bag

    with open_bag(bag) as reader:
        return reader.duration * 1e-9


if __name__ == '__main__':
    main()
