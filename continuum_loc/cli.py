"""
The command line `continuum-loc`.

Each command reads its arguments and calls the library; work is done there. It imports what it
needs itself, so that `--help` takes a tenth of a second.

Exit codes: 0 done, 1 a claim or a comparison failed, 2 wrong usage or input.
"""

from __future__ import annotations

from collections.abc import Iterable
import json
from pathlib import Path
import sys
from typing import Annotated, Any, TYPE_CHECKING

from continuum_loc.errors import ContinuumLocError, InputError, StudyError
from rich.console import Console
from rich.markup import escape
import typer

if TYPE_CHECKING:
    from continuum_loc.offline.claims import Claim

OK, FAILED, USAGE = 0, 1, 2

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


def main() -> None:
    """
    Entry point of the command.

    Errors of our own are told in one line, anything else is a bug and keeps its traceback.
    """
    try:
        app()
    except ContinuumLocError as error:
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
    console.print(_run_table(outcome.summary))
    console.print(
        f'report  [link=file://{outcome.folder}/report.html]{outcome.folder}/report.html[/link]'
    )
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
    duration: Annotated[
        float | None, typer.Option(help='seconds; default: the whole trajectory')
    ] = None,
    seed: Annotated[int, typer.Option(help='seed of everything random', min=0)] = 0,
) -> None:
    """
    Record a simulated trial, sensors and truth, into a bag (rosbag2, MCAP) as fast as it goes.

    Example: `continuum-loc simulate /tmp/trial --scene S3 --trajectory t2 --seed 4`
    """
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
    )
    with _busy() as status:
        status.update('building the scene and letting the robot come to rest')
        made = world(trial)
    seconds = made.trajectory.duration if duration is None else duration
    counts = write_bag(bag, _progress(made.run(duration), 'simulating', seconds))
    _count_table(counts, f'{bag}: {seconds:g} s')


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
        str,
        typer.Option(
            help='scene shown in the report, and whose map is taken where `--map` is not given'
        ),
    ] = 'S0',
    settings: Settings = None,
    seed: Seed = 0,
    out: Runs = Path('runs'),
) -> None:
    """
    Localise from a recorded bag without a ROS graph.

    The same bag gives the same estimate, bit for bit.

    Example: `continuum-loc replay runs/latest/bag --map my_map.ply --robot my_robot.yaml`
    """
    from continuum_loc.estimator import settings_of
    from continuum_loc.mapping.scale import map_for
    from continuum_loc.offline.replay import replay as run_replay
    from continuum_loc.offline.replay import samples_of
    from continuum_loc.offline.runs import new_run, save_run
    from continuum_loc.offline.trials import make_filter, scene_map_file
    from continuum_loc.robot import load_robot

    description = load_robot(robot)
    with _busy() as status:
        status.update('loading the prior map')
        map_file = map_file or scene_map_file(scene)
        prior = map_for(description, map_file)
        estimator = make_filter(description, prior, settings_of(description.name, settings))
    _say(map_file, prior.notes)
    result = run_replay(_progress(samples_of(bag), 'replaying', _bag_duration(bag)), estimator)
    folder = new_run('replay', out)
    summary = save_run(
        folder,
        result,
        kind='replay',
        seed=seed,
        configuration={
            'robot': description,
            'bag': bag,
            'map': {'file': map_file},
            'scene': scene,
            'estimator': estimator.settings,
        },
    )
    _write_report(folder)
    console.print(_run_table(summary))
    console.print(f'report  {folder}/report.html')


@app.command()
def shape(
    bag: Annotated[Path, typer.Argument(help='bag folder, or .mcap or .db3 file')],
    robot: Robot = 'hall_arm',
    settings: Annotated[
        Path | None, typer.Option(help="shape settings (YAML); default: the package's")
    ] = None,
    out: Runs = Path('runs'),
) -> None:
    """
    Estimate the shape from Hall sensors and IMUs of a recorded bag.

    The robot rests while it begins.

    Example: `continuum-loc shape bench_top.mcap --robot my_arm.yaml`
    """
    from continuum_loc.offline.replay import replay as run_replay
    from continuum_loc.offline.replay import samples_of
    from continuum_loc.offline.runs import new_run, save_run
    from continuum_loc.offline.shape_replay import ShapeReplay
    from continuum_loc.robot import load_robot
    from continuum_loc.shape import load_shape_settings

    description = load_robot(robot)
    estimator = ShapeReplay(description, load_shape_settings(settings))
    result = run_replay(_progress(samples_of(bag), 'estimating', _bag_duration(bag)), estimator)
    folder = new_run('shape', out)
    summary = save_run(
        folder,
        result,
        kind='shape',
        seed=None,
        configuration={'robot': description, 'bag': bag, 'estimator': estimator.settings},
    )
    _write_report(folder)
    console.print(_run_table(summary))
    console.print(f'report  {folder}/report.html')


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
    from continuum_loc.offline.trials import scene_map_file, simulate, write_bag
    from continuum_loc.offline.tune import FACTORS, hold_out, PARAMETERS
    from continuum_loc.offline.tune import tune as sweep
    from continuum_loc.robot import load_robot
    from continuum_loc.settings import dump_settings
    from rich.progress import Progress

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
    best_tried = min(tried, key=lambda one: one.cost)
    for name, one in (('start', tried[0]), ('best', best_tried)):
        console.print(
            f'{name:6}{100 * one.translation_rmse_m:.3f} cm  {one.rotation_rmse_deg:.3f} deg  '
            f'NEES/dof {one.nees_per_dof:.2f}',
            highlight=False,
        )
    console.print(f'written {out}')


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
    jobs: Annotated[int, typer.Option(help='processes', min=1)] = 1,
    minutes: Annotated[
        float | None, typer.Option(help='with `soak`: how long, instead of half an hour', min=0.5)
    ] = None,
    scheduler: Annotated[
        str, typer.Option(help='address of a Dask scheduler to run the trials on')
    ] = '',
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

    Example: `continuum-loc evaluate table2 --quick --jobs 2`, `continuum-loc evaluate bags my_bags
    --map my_map.npz`
    """
    from continuum_loc.offline.parallel import SCHEDULER
    from continuum_loc.offline.runs import new_run

    if name is None:
        require_research()
        from studies import study_names

        console.print('studies: ' + ', '.join([*study_names(), 'bags DIR']))
        return
    if name == 'bags' and (folder is None or map_file is None):
        raise typer.BadParameter('bags needs a folder and a map: evaluate bags DIR --map FILE')
    if minutes is not None and name != 'soak':
        raise typer.BadParameter('--minutes goes with soak')
    run = None if name == 'bags' else _study(name)
    out = out or new_run(name)
    out.mkdir(parents=True, exist_ok=True)
    SCHEDULER.set(scheduler)
    if run is None:
        claims = _evaluate_bags(folder, robot, map_file, settings, out, jobs)
    elif minutes is not None:
        from studies.soak import soak

        claims = soak(out, 60.0 * minutes, seed)
    else:
        claims = run(out, quick, seed, jobs)
    console.print(_claims_table(claims))
    for trial, error in _failed(out, name).items():
        errors.print(f'[bold red]failed:[/] {escape(f"{trial}: {error}")}', highlight=False)
    console.print(f'results {out}')
    raise typer.Exit(OK if all(claim.holds for claim in claims) else FAILED)


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


def _progress(samples: Any, label: str, seconds: float | None) -> Any:
    """Pass samples on, with a bar over the time that their stamps span."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        TextColumn('{task.completed:.1f} s'),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=errors, transient=True) as progress:
        task, first, shown = progress.add_task(label, total=seconds), None, 0.0
        for sample in samples:
            first = sample.stamp if first is None else first
            elapsed = (sample.stamp - first) * 1e-9
            if elapsed - shown > 0.1:
                shown = elapsed
                progress.update(task, completed=shown)
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
