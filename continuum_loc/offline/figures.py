"""
The plotly figures of a report.

Each function takes results and gives one figure; none knows about HTML.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from continuum_loc.measurements import NANOSECONDS
from continuum_loc.offline.metrics import drift_band, Errors
from continuum_loc.offline.replay import ReplayResult
from continuum_loc.offline.view import Moment, Surroundings
import numpy as np

if TYPE_CHECKING:
    import plotly.graph_objects as go

MOST_SAMPLES = 2000
INK, GRID, TRUTH, ESTIMATE, POINTS, MAP = (
    '#1f2933',
    '#e4e7eb',
    '#111827',
    '#e4572e',
    '#0b8f8c',
    '#8896a8',
)
RING_COLOURS = (
    '#355070',
    '#6d597a',
    '#b56576',
    '#e56b6f',
    '#eaac8b',
    '#3d8b7d',
    '#7b9e3f',
    '#4a6fa5',
)
COMPONENTS = ('along x', 'along y', 'along z', 'about x', 'about y', 'about z')


def error_figure(found: Errors, kind: str, lost: np.ndarray, epoch: int) -> go.Figure:
    """
    One panel per ring: the error over time above its 3-sigma band.

    kind: `translation` or `rotation`. lost: (K,) bool, shaded. epoch: stamp of time zero.
    """
    from plotly.subplots import make_subplots

    rings = range(1, len(found.names))
    figure = make_subplots(rows=len(rings), cols=1, shared_xaxes=True, vertical_spacing=0.025)
    time = (found.stamps - epoch) / NANOSECONDS
    for row, ring in enumerate(rings, start=1):
        values, band = _error_and_band(found, kind, ring)
        kept = thin(values)
        _band_traces(
            figure,
            row,
            time[kept],
            values[kept],
            band[kept],
            RING_COLOURS[(ring - 1) % len(RING_COLOURS)],
            found.names[ring],
        )
    for start, end in spans(time, lost):
        figure.add_vrect(x0=start, x1=end, fillcolor='#f5b700', opacity=0.25, line_width=0)
    figure.update_xaxes(title_text='time [s]', row=len(rings), col=1)
    return styled(figure, 130 * len(rings) + 70)


def _error_and_band(found: Errors, kind: str, ring: int) -> tuple[np.ndarray, np.ndarray]:
    """Error and three sigmas of a ring: cm for `translation`, degrees for `rotation`."""
    translation_band, rotation_band = drift_band(found, ring)
    if kind == 'translation':
        return 100.0 * found.translation_m[:, ring], 100.0 * translation_band
    return found.rotation_deg[:, ring], rotation_band


def _band_traces(
    figure: go.Figure,
    row: int,
    time: np.ndarray,
    values: np.ndarray,
    band: np.ndarray,
    colour: str,
    name: str,
) -> None:
    import plotly.graph_objects as go

    figure.add_trace(
        go.Scatter(
            x=time,
            y=_compact(band),
            mode='lines',
            fill='tozeroy',
            showlegend=False,
            line={'width': 0.8, 'color': '#c3cbd5'},
            fillcolor='rgba(136,150,168,0.20)',
            name='3 sigma',
            hovertemplate='3 sigma %{y:.3g}<extra></extra>',
        ),
        row=row,
        col=1,
    )
    figure.add_trace(
        go.Scatter(
            x=time,
            y=_compact(values),
            mode='lines',
            showlegend=False,
            name=name,
            line={'width': 1.6, 'color': colour},
            hovertemplate=f'{name} %{{y:.3g}}<extra></extra>',
        ),
        row=row,
        col=1,
    )
    figure.update_yaxes(
        title_text=name,
        title_font={'size': 11, 'color': colour},
        range=[0.0, ceiling(values, band)],
        row=row,
        col=1,
    )


def ceiling(values: np.ndarray, band: np.ndarray) -> float:
    """
    Height of a panel that shows all errors, and their band but for its rare peaks.

    A step without measurements has a band many times the usual one, beside which no error shows.
    """
    usual = np.quantile(band[np.isfinite(band)], 0.98) if np.isfinite(band).any() else 0.0
    return 1.1 * float(max(np.nanmax(values, initial=0.0), usual, 1e-6))


def component_figure(found: Errors, epoch: int) -> go.Figure:
    """
    Plot the six components of a ring's pose error between plus and minus 3 sigma.

    A menu in the figure chooses the ring.
    """
    from plotly.subplots import make_subplots

    figure = make_subplots(
        rows=3,
        cols=2,
        shared_xaxes=True,
        vertical_spacing=0.07,
        horizontal_spacing=0.14,
        subplot_titles=[
            COMPONENTS[i] for pair in zip(range(3), range(3, 6), strict=True) for i in pair
        ],
    )
    for ring in range(1, len(found.names)):
        for component in range(6):
            place = {'row': component % 3 + 1, 'col': component // 3 + 1}
            for trace in _component_traces(found, epoch, ring, component):
                figure.add_trace(trace, **place)
    figure.update_layout(updatemenus=[_ring_menu(found.names[1:])])
    figure.update_yaxes(title_text='cm', col=1)
    figure.update_yaxes(title_text='deg', col=2)
    figure.update_xaxes(title_text='time [s]', row=3)
    return styled(figure, 560, top=70)


def _component_traces(
    found: Errors, epoch: int, ring: int, component: int
) -> tuple[go.Scatter, go.Scatter]:
    """Draw the 3-sigma band and the error of one component of a ring, in cm or degrees."""
    import plotly.graph_objects as go

    time = (found.stamps - epoch) / NANOSECONDS
    scale = 100.0 if component < 3 else np.degrees(1.0)
    values, band = (scale * array[:, ring, component] for array in (found.pose, 3.0 * found.sigma))
    band = np.minimum(band, ceiling(np.abs(values), band))
    kept = thin(np.abs(values))
    shown = {'visible': ring == len(found.names) - 1, 'showlegend': False}
    return (
        go.Scatter(
            x=np.concatenate([time[kept], time[kept][::-1]]),
            y=_compact(np.concatenate([band[kept], -band[kept][::-1]])),
            fill='toself',
            fillcolor='rgba(136,150,168,0.22)',
            line={'width': 0},
            hoverinfo='skip',
            **shown,
        ),
        go.Scatter(
            x=time[kept],
            y=_compact(values[kept]),
            mode='lines',
            line={'width': 1.3, 'color': RING_COLOURS[(ring - 1) % len(RING_COLOURS)]},
            hovertemplate='%{y:.3g}<extra></extra>',
            **shown,
        ),
    )


def _ring_menu(names: tuple[str, ...]) -> dict:
    buttons = [
        {
            'label': name,
            'method': 'restyle',
            'args': [{'visible': [other == name for other in names for _ in range(12)]}],
        }
        for name in names
    ]
    return {
        'buttons': buttons,
        'active': len(names) - 1,
        'x': 0.0,
        'xanchor': 'left',
        'y': 1.16,
        'yanchor': 'bottom',
        'pad': {'t': 0, 'b': 0},
    }


def time_histogram(milliseconds: np.ndarray, title: str, limit: float | None = None) -> go.Figure:
    """Histogram of times [ms], with p95 and p99, and the time there is."""
    import plotly.graph_objects as go

    figure = go.Figure(
        go.Histogram(
            x=_compact(milliseconds),
            nbinsx=60,
            marker={'color': '#4a6fa5'},
            hovertemplate='%{x} ms: %{y}<extra></extra>',
        )
    )
    marks = (
        [(float(np.percentile(milliseconds, q)), f'p{q}', INK) for q in (50, 95, 99)]
        if len(milliseconds)
        else []
    )
    if limit is not None:
        marks.append((limit, f'{limit:g} ms', ESTIMATE))
    for height, (value, label, colour) in enumerate(marks):
        figure.add_vline(x=value, line={'width': 1.2, 'dash': 'dot', 'color': colour})
        figure.add_annotation(
            x=value,
            y=1.0 - 0.1 * height,
            yref='paper',
            text=label,
            showarrow=False,
            xanchor='left',
            font={'size': 11, 'color': colour},
        )
    figure.update_xaxes(title_text=title)
    figure.update_yaxes(title_text='steps')
    return styled(figure, 280)


def consistency_figure(result: ReplayResult, found: Errors) -> go.Figure:
    """Plot what the filter (innovations) and truth (NEES) say of it, both 1 when honest."""
    import plotly.graph_objects as go

    epoch = int(result.track.stamps[0]) if len(result.track) else 0
    figure = go.Figure()
    if len(found) and np.isfinite(found.nees).any():
        nees = (
            np.nanmean(np.where(np.isfinite(found.nees[:, 1:]), found.nees[:, 1:], np.nan), axis=1)
            / 6.0
        )
        kept = thin(nees)
        figure.add_scatter(
            x=(found.stamps[kept] - epoch) / NANOSECONDS,
            y=_compact(nees[kept]),
            mode='lines',
            name='NEES per dof (needs truth)',
            line={'width': 1.3, 'color': ESTIMATE},
        )
    kept = thin(result.consistency)
    figure.add_scatter(
        x=(result.track.stamps[kept] - epoch) / NANOSECONDS,
        y=_compact(result.consistency[kept]),
        mode='lines',
        name='innovations (online)',
        line={'width': 1.3, 'color': '#4a6fa5'},
    )
    figure.add_hline(y=1.0, line={'width': 1, 'dash': 'dot', 'color': INK})
    figure.update_yaxes(type='log', title_text='normalised squared')
    figure.update_xaxes(title_text='time [s]')
    figure.update_layout(legend={'orientation': 'h', 'y': 1.02, 'yanchor': 'bottom', 'x': 0})
    return styled(figure, 280, top=40)


def scene_figure(around: Surroundings, shown: list[Moment], epoch: int) -> go.Figure:
    """
    Make the 3-D view: surroundings that stay, and the body with its ToF points at each moment.

    It has a slider and a play button.
    """
    import plotly.graph_objects as go

    still = _still_traces(around)
    frames = [
        go.Frame(
            name=str(index),
            data=_moving_traces(moment),
            traces=list(range(len(still), len(still) + 4)),
        )
        for index, moment in enumerate(shown)
    ]
    # The middle shows more than the start, where no points have been gathered yet.
    first = len(shown) // 2
    figure = go.Figure(data=still + (_moving_traces(shown[first]) if shown else []), frames=frames)
    if shown:
        figure.update_layout(
            sliders=[{**_slider(shown, epoch), 'active': first}], updatemenus=[_play_buttons()]
        )
    hidden = {
        'showgrid': False,
        'zeroline': False,
        'showbackground': False,
        'title': '',
        'showticklabels': False,
        'showspikes': False,
        'visible': False,
    }
    figure.update_layout(
        scene={
            'aspectmode': 'data',
            'xaxis': hidden,
            'yaxis': hidden,
            'zaxis': hidden,
            'dragmode': 'orbit',
            'camera': camera_towards(around, shown),
        },
        legend={
            'orientation': 'h',
            'y': 1.0,
            'yanchor': 'bottom',
            'x': 0,
            'itemsizing': 'constant',
        },
        margin={'l': 0, 'r': 0, 't': 0, 'b': 0},
        paper_bgcolor='white',
        height=620,
        uirevision='keep',
        font={'family': 'system-ui, sans-serif', 'size': 12, 'color': INK},
    )
    return figure


def camera_towards(around: Surroundings, shown: list[Moment]) -> dict:
    """Look from the side and above, so that where the body goes fills the frame."""
    spread = np.concatenate(
        [around.vertices, around.map_points, *(moment.backbone for moment in shown)]
    )
    body = np.concatenate([moment.backbone for moment in shown]) if shown else spread
    if len(spread) == 0:
        return {}
    low, high = spread.min(axis=0), spread.max(axis=0)
    # Plotly's camera works in units of the data's box scaled to about one, seen from its middle.
    unit = np.prod(np.maximum(high - low, 1e-9)) ** (1.0 / 3.0)
    centre = (0.5 * (body.min(axis=0) + body.max(axis=0)) - 0.5 * (low + high)) / unit
    eye = centre + np.array([-0.45, -0.95, 0.5])
    return {
        name: dict(zip('xyz', place.tolist(), strict=True))
        for name, place in (('center', centre), ('eye', eye))
    }


def _still_traces(around: Surroundings) -> list[go.Scatter3d | go.Mesh3d]:
    import plotly.graph_objects as go

    traces: list = []
    if len(around.faces):
        x, y, z = _compact(around.vertices).T
        i, j, k = around.faces.T.astype(np.int32)
        traces.append(
            go.Mesh3d(
                x=x,
                y=y,
                z=z,
                i=i,
                j=j,
                k=k,
                color='#d3dbe6',
                opacity=0.3,
                flatshading=True,
                name='scene',
                showlegend=True,
                hoverinfo='skip',
                lighting={'ambient': 0.75, 'diffuse': 0.45, 'specular': 0.05, 'roughness': 0.9},
            )
        )
    if len(around.map_points):
        traces.append(
            _dots(
                around.map_points, MAP, 1.3, 'prior map', visible='legendonly' if traces else True
            )
        )
    return traces


def _moving_traces(moment: Moment) -> list[go.Scatter3d]:
    return [
        _line(moment.truth, TRUTH, 9, 'true backbone'),
        _line(moment.backbone, ESTIMATE, 5, 'estimated backbone'),
        _dots(moment.rings, ESTIMATE, 5, 'rings'),
        _dots(moment.points, POINTS, 2.2, 'ToF points'),
    ]


def _line(points: np.ndarray, colour: str, width: float, name: str) -> go.Scatter3d:
    import plotly.graph_objects as go

    x, y, z = _compact(points).T
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        mode='lines',
        name=name,
        line={'color': colour, 'width': width},
        hoverinfo='name',
    )


def _dots(
    points: np.ndarray, colour: str, size: float, name: str, visible: bool | str = True
) -> go.Scatter3d:
    import plotly.graph_objects as go

    x, y, z = _compact(points).T
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        mode='markers',
        name=name,
        marker={'color': colour, 'size': size},
        hoverinfo='skip',
        visible=visible,
    )


ANIMATION = {'mode': 'immediate', 'fromcurrent': True, 'transition': {'duration': 0}}


def _slider(shown: list[Moment], epoch: int) -> dict:
    steps = [
        {
            'label': f'{(moment.stamp - epoch) / NANOSECONDS:.1f}',
            'method': 'animate',
            'args': [[str(index)], {**ANIMATION, 'frame': {'duration': 0, 'redraw': True}}],
        }
        for index, moment in enumerate(shown)
    ]
    return {
        'steps': steps,
        'x': 0.16,
        'len': 0.82,
        'y': 0.04,
        'yanchor': 'bottom',
        'pad': {'t': 0, 'b': 0},
        'ticklen': 0,
        'font': {'color': 'rgba(0,0,0,0)', 'size': 1},
        'currentvalue': {
            'prefix': 't = ',
            'suffix': ' s',
            'font': {'size': 13, 'color': INK},
            'xanchor': 'left',
        },
        'bordercolor': '#c3cbd5',
        'bgcolor': '#eef1f5',
    }


def _play_buttons() -> dict:
    play = {
        'label': '&#9654;',
        'method': 'animate',
        'args': [None, {**ANIMATION, 'frame': {'duration': 120, 'redraw': True}}],
    }
    pause = {
        'label': '&#10074;&#10074;',
        'method': 'animate',
        'args': [[None], {**ANIMATION, 'frame': {'duration': 0, 'redraw': False}}],
    }
    return {
        'type': 'buttons',
        'direction': 'right',
        'buttons': [play, pause],
        'x': 0.02,
        'xanchor': 'left',
        'y': 0.04,
        'yanchor': 'bottom',
        'pad': {'t': 0, 'b': 0},
        'showactive': False,
    }


def thin(values: np.ndarray, most: int = MOST_SAMPLES) -> np.ndarray:
    """Pick the greatest of each stretch of the values (K,), at most `most`, by index."""
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most + 1).astype(int)
    filled = np.where(np.isfinite(values), values, -np.inf)
    return np.array(
        [
            start + int(np.argmax(filled[start:end]))
            for start, end in zip(edges, edges[1:], strict=False)
        ]
    )


def spans(time: np.ndarray, flags: np.ndarray) -> list[tuple[float, float]]:
    """Intervals of `time` (K,) over which `flags` (K,) are true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(float(time[start]), float(time[end - 1])) for start, end in edges.reshape(-1, 2)]


def _compact(values: np.ndarray) -> np.ndarray:
    """Single precision: what a picture needs, in half of the bytes."""
    return np.asarray(values, np.float32)


def styled(figure: go.Figure, height: int, top: int = 20) -> go.Figure:
    """Give a chart the look of the report, and return it."""
    figure.update_layout(
        template='plotly_white',
        height=height,
        margin={'l': 56, 'r': 12, 't': top, 'b': 42},
        hovermode='x',
        font={'family': 'system-ui, sans-serif', 'size': 12, 'color': INK},
    )
    figure.update_xaxes(gridcolor=GRID, zeroline=False)
    figure.update_yaxes(gridcolor=GRID, zerolinecolor='#9aa5b1')
    return figure
