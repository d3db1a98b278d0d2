"""
One self-contained HTML page about a run.

What it reached, where it was worst, and a 3-D view to turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from continuum_loc.measurements import NANOSECONDS
from continuum_loc.offline import figures
from continuum_loc.offline.account import account_lines
from continuum_loc.offline.metrics import DOF, Errors, errors
from continuum_loc.offline.runs import Run, settled
from continuum_loc.offline.view import moments, surroundings
from continuum_loc.trajectory import associate
import numpy as np
import yaml

FRAMES, FRAME_POINTS, SCENE_FACES, MAP_POINTS, REACH = 90, 500, 24_000, 9_000, 0.55
WORST, APART = 8, 0.5  # how many of the worst moments are listed, and how far apart at least [s]
CHART = {
    'responsive': True,
    'displaylogo': False,
    'modeBarButtonsToRemove': ['select2d', 'lasso2d', 'autoScale2d'],
}


@dataclass(frozen=True)
class Row:
    """A table's row; `frame` is the moment of the 3-D view that a click leads to."""

    cells: Sequence[str]
    frame: int | None = None
    total: bool = False


@dataclass(frozen=True)
class Table:
    """`words` are the indices of the columns that hold text, not numbers."""

    columns: Sequence[str]
    rows: Sequence[Row]
    words: Sequence[int] = (0,)


@dataclass(frozen=True)
class Part:
    """A titled box of the page: a note, a table, a figure (HTML), any of them."""

    title: str
    note: str = ''
    table: Table | None = None
    figure: str = ''
    name: str = ''


@dataclass(frozen=True)
class Page:
    """Groups of one part span the page, groups of two stand side by side where there is room."""

    title: str
    subtitle: str
    cards: Sequence[tuple[str, str]]
    groups: Sequence[Sequence[Part]]
    configuration: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Context:
    """
    What a run took place in.

    The scene's mesh (vertices, faces) and the prior map's points, where known. `missing` says what
    could not be found.
    """

    mesh: tuple[np.ndarray, np.ndarray] | None = None
    map_points: np.ndarray | None = None
    missing: str = ''


def write_report(run: Run, context: Context | None = None) -> Path:
    """Write `report.html` into the run's folder and return its path."""
    path = run.folder / 'report.html'
    path.write_text(render(run_page(run, context or Context())))
    return path


def context_of(run: Run) -> Context:
    """Find the scene and the prior map that the run's configuration names, if they still are."""
    from continuum_loc.errors import MapError, SceneError
    from continuum_loc.mapping.map_files import load_map
    from continuum_loc.offline.scene_maps import scene_map
    from continuum_loc.simulator.scenes import load_scene

    mesh = map_points = None
    named = run.configuration.get('map') or {}
    try:
        if run.configuration.get('scene'):
            scene = load_scene(run.configuration['scene'])
            mesh = (scene.vertices, scene.faces)
        if 'file' in named:
            map_points = load_map(named['file']).points
        elif 'scene' in named:
            map_points = scene_map(named['scene']).points
    except (
        SceneError,
        MapError,
    ) as error:  # moved since: the report says so, and stands without it
        return Context(mesh, map_points, missing=str(error))
    return Context(mesh, map_points)


def render(page: Page) -> str:
    """Render the page as HTML, with plotly's script inside, so that it needs no network."""
    from jinja2 import Environment, PackageLoader
    from plotly.offline import get_plotlyjs

    environment = Environment(
        loader=PackageLoader('continuum_loc.offline'), autoescape=True, trim_blocks=True
    )
    return environment.get_template('report.html.j2').render(
        title=page.title,
        subtitle=page.subtitle,
        groups=page.groups,
        plotly=get_plotlyjs(),
        cards=[{'label': label, 'value': value} for label, value in page.cards],
        configuration=yaml.safe_dump(dict(page.configuration), sort_keys=False)
        if page.configuration
        else '',
    )


def run_page(run: Run, context: Context) -> Page:
    """Make the page about one run."""
    result, summary = run.result, run.summary
    found = errors(settled(result.track), result.truth)
    worst = worst_moments(found)
    epoch = int(result.track.stamps[0]) if len(result.track) else 0
    shown = moments(result, FRAMES, FRAME_POINTS, REACH, extra=found.stamps[worst])
    frame_of = {moment.stamp: index for index, moment in enumerate(shown)}
    around = surroundings(result, context.mesh, context.map_points, REACH, SCENE_FACES, MAP_POINTS)
    view = Part(
        'The robot in its scene',
        'Drag to turn, scroll or pinch to zoom; the slider moves through time. '
        f"The prior map's points can be switched on in the legend. {context.missing}",
        name='view',
        figure=chart(figures.scene_figure(around, shown, epoch)),
    )
    groups = [
        [Part('Errors against truth, per ring', table=ring_table(summary))] if len(found) else [],
        [view],
        *_error_groups(run, found, epoch),
        _worst_group(run, found, worst, frame_of, epoch),
        list(_speed_parts(run)),
        [
            Part(
                'Consistency',
                "Both curves stay near 1 when the filter's covariance is "
                'honest; above 1 it is too sure of itself.',
                figure=chart(figures.consistency_figure(result, found)),
            )
        ],
        [Part('What came of it', table=account_table(summary))] if 'account' in summary else [],
        [Part('Measurements', table=counts_table(summary['counts']))],
    ]
    return Page(
        f'{run.folder.name}',
        subtitle(run),
        headline(summary),
        [group for group in groups if group],
        run.configuration,
    )


def chart(figure: Any) -> str:
    """Render a figure as an HTML fragment that follows the page's width."""
    import plotly.io as pio

    return pio.to_html(
        figure, full_html=False, include_plotlyjs=False, config=CHART, auto_play=False
    )


def subtitle(run: Run) -> str:
    """Say what was run, in one line."""
    names = {key: run.configuration.get(key) for key in ('scene', 'trajectory', 'profile', 'bag')}
    robot = run.configuration.get('robot')
    names = {'robot': robot.get('name') if isinstance(robot, Mapping) else robot, **names}
    said = [f'{key} {value}' for key, value in names.items() if value]
    return ' · '.join(
        [
            run.summary['kind'],
            *said,
            f'seed {run.summary.get("seed")}',
            f'{run.summary["data_seconds"]:.1f} s of data',
        ]
    )


def headline(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Choose the figures that one wants to see first, as (label, value)."""
    cards = [
        ('translation, mean over rings', number(summary['translation_mae_m'], 100, ' cm')),
        ('rotation, mean over rings', number(summary['rotation_mae_deg'], 1, '°')),
        ('NEES per degree of freedom', number(summary['nees_per_dof'])),
        ('inside the 95 % bound', number(summary['coverage_95'], 100, ' %', digits=1)),
        ('real-time factor', number(summary['real_time_factor'], 1, ' ×', digits=1)),
        ('step, 99th percentile', number(summary['step_ms']['p99'], 1, ' ms', digits=1)),
    ]
    if 'latency_ms' in summary:
        cards.append(
            (
                'latency live, 95th percentile',
                number(summary['latency_ms']['p95'], 1, ' ms', digits=1),
            )
        )
    lost = summary['estimates']['lost']
    cards.append(('of the estimates said lost', f'{lost} of {summary["estimates"]["all"]}'))
    return cards


def ring_table(summary: Mapping[str, Any]) -> Table:
    """
    MAE, RMSE, greatest error and consistency.

    For each ring, for all of them, and for the base apart.
    """

    def row(name: str, entry: Mapping[str, Any], total: bool = False) -> Row:
        lengths = [number(entry[f'translation_{key}_m'], 100) for key in ('mae', 'rmse', 'max')]
        angles = [number(entry[f'rotation_{key}_deg']) for key in ('mae', 'rmse', 'max')]
        return Row(
            [
                name,
                *lengths,
                *angles,
                number(entry['nees_per_dof']),
                number(entry['coverage_95'], 100, digits=1),
            ],
            total=total,
        )

    rows = [row(name, entry) for name, entry in summary['rings'].items()]
    columns = [
        '',
        'MAE cm',
        'RMSE cm',
        'max cm',
        'MAE deg',
        'RMSE deg',
        'max deg',
        'NEES/dof',
        'in 95 % bound, %',
    ]
    return Table(
        columns,
        [*rows, row('all rings', summary, total=True), row('base (given)', summary['base'])],
    )


def account_table(summary: Mapping[str, Any]) -> Table:
    """List what the terminal said at the end, a line each."""
    return Table([''], [Row([line]) for line in account_lines(summary['account'])])


def counts_table(counts: Mapping[str, Any]) -> Table:
    """Nested counts, one line each."""
    return Table(
        ['what', 'how many'],
        [
            Row([name, f'{value:,}' if isinstance(value, int) else str(value)])
            for name, value in _flat(counts)
        ],
    )


def worst_moments(found: Errors) -> np.ndarray:
    """
    Find the instants with the greatest translation error of any ring, the worst first.

    They are indices, at least half a second apart.
    """
    if len(found) == 0:
        return np.empty(0, int)
    peak = found.translation_m[:, 1:].max(axis=1)
    chosen: list[int] = []
    for index in np.argsort(-peak):
        if all(
            abs(found.stamps[index] - found.stamps[other]) >= APART * NANOSECONDS
            for other in chosen
        ):
            chosen.append(int(index))
        if len(chosen) == WORST:
            break
    return np.array(chosen)


def _worst_group(
    run: Run, found: Errors, worst: np.ndarray, frame_of: Mapping[int, int], epoch: int
) -> list[Part]:
    if len(worst) == 0:
        return []
    status = dict(zip(run.result.track.stamps.tolist(), _statuses(run), strict=True))
    rows = []
    for index in worst:
        stamp, ring = int(found.stamps[index]), 1 + int(np.argmax(found.translation_m[index, 1:]))
        band = figures.drift_band(found, ring)[0][index]
        rows.append(
            Row(
                [
                    f'{(stamp - epoch) / NANOSECONDS:.2f}',
                    found.names[ring],
                    number(found.translation_m[index, ring], 100),
                    number(band, 100),
                    number(found.rotation_deg[index, ring]),
                    number(found.nees[index, ring] / DOF),
                    status[stamp],
                ],
                frame=frame_of.get(stamp),
            )
        )
    columns = [
        'time s',
        'ring',
        'error cm',
        '3 sigma cm',
        'rotation deg',
        'NEES/dof',
        'filter says',
    ]
    return [
        Part(
            'Worst moments first',
            'A click on a line shows the moment in the 3-D view.',
            Table(columns, rows, words=(1, 6)),
        )
    ]


def _statuses(run: Run) -> list[str]:
    status = run.result.track.status
    return ['-'] * len(run.result.track) if status is None else status.tolist()


def _error_groups(run: Run, found: Errors, epoch: int) -> Iterator[list[Part]]:
    if len(found) == 0:
        yield [
            Part(
                'Errors',
                'No truth was recorded at the times of the estimates, so no error can be told.',
            )
        ]
        return
    judged = associate(settled(run.result.track), run.result.truth)[0]
    lost = judged.status == 'lost' if judged.status is not None else np.zeros(len(found), bool)
    shade = (
        'Grey: three standard deviations as the filter states them, rare peaks cut off. '
        'Yellow: the filter says that it is lost.'
    )
    yield [
        Part(
            'Translation error, cm',
            shade,
            figure=chart(figures.error_figure(found, 'translation', lost, epoch)),
        ),
        Part(
            'Rotation error, degrees',
            shade,
            figure=chart(figures.error_figure(found, 'rotation', lost, epoch)),
        ),
    ]
    yield [
        Part(
            'Error by component',
            "In the ring's own frame, x along the backbone, with plus and minus 3 sigma, "
            'rare peaks cut off.',
            figure=chart(figures.component_figure(found, epoch)),
        )
    ]


def _speed_parts(run: Run) -> Iterator[Part]:
    steps = 1e3 * run.result.step_seconds
    if len(steps):
        factor = run.summary['real_time_factor']
        note = (
            f'{run.summary["data_seconds"]:.1f} s of data in '
            f'{run.result.processing_seconds:.2f} s: '
            f'real-time factor {number(factor, digits=1)} on one core.'
        )
        yield Part('Time per step', note, figure=chart(figures.time_histogram(steps, 'step [ms]')))
    latency = 1e3 * run.result.latency_seconds
    if len(latency):
        yield Part(
            'Latency, live',
            'From the stamp of the newest ToF frame to the published pose.',
            figure=chart(figures.time_histogram(latency, 'latency [ms]', limit=66.0)),
        )


def _flat(counts: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in counts.items():
        where = f'{prefix} {name}'.strip().replace('_', ' ')
        if isinstance(value, Mapping):
            yield from _flat(value, where + ':' if prefix == '' else where)
        else:
            yield where, value


def number(value: float | None, scale: float = 1.0, unit: str = '', digits: int = 2) -> str:
    """Write a figure as one reads it; a dash where there is none."""
    if value is None or not np.isfinite(value):
        return '–'
    return f'{scale * value:.{digits}f}{unit}'
