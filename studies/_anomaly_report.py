"""The report of the anomalies study: claims, tables, precision and recall, scenes in 3-D."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

from continuum_loc.offline.claims import Claim
from continuum_loc.offline.figures import INK, styled
from continuum_loc.offline.report import chart, Page, Part, render
from continuum_loc.offline.study_report import as_table, claims_part
from continuum_loc.scene.anomalies import AnomalySettings
import numpy as np
from studies._paper_figures import html
from studies._scene_result import SceneResult

if TYPE_CHECKING:
    import plotly.graph_objects as go

COLOURS = {'added': '#c0392b', 'missing': '#2457a6'}
MOST_SCENES = 4  # pictures in one page: each is about half a megabyte
CLUSTER_POINTS = 400  # shown of each cluster


def write_anomaly_report(
    path: Path,
    claims: Sequence[Claim],
    tables: dict[str, list[dict[str, Any]]],
    results: Sequence[SceneResult],
) -> Path:
    """Write the page; the scenes with most anomalies to be found come first."""
    ranked = sorted(results, key=lambda one: -len(one.truth))
    groups = [
        [claims_part(claims)],
        [
            Part(
                'Scenes',
                'Distances to the true mesh. The paper reports 0.8, 1.2 and 1.4 cm for three '
                'of its real scenes.',
                table=as_table(rounded(tables['reconstruction'])),
            )
        ],
        [
            Part(
                'Precision and recall',
                'Over the confidence that a cluster needs, all scenes together.',
                figure=chart(curve_figure(tables['precision_recall'])),
            ),
            Part('The same as numbers', table=as_table(rounded(tables['precision_recall']))),
        ],
        *(
            [
                Part(
                    f'Scene {result.scene}: truth, prior map, reconstruction, and what was found',
                    'As Figs. 5, 7 and 9 of the paper.',
                    figure=html(result.picture),
                ),
                Part(
                    f'Scene {result.scene}',
                    'Coloured by depth; red: new, blue: missing. Outlined: what truly differs.',
                    figure=chart(scene_figure(result)),
                ),
            ]
            for result in ranked[:MOST_SCENES]
        ),
        [Part('Clusters', table=as_table(rounded(tables['clusters'])))],
    ]
    held = sum(claim.holds for claim in claims)
    page = Page(
        'Reconstruction and anomalies',
        f'{len(results)} scenes',
        [('claims that hold', f'{held} of {len(claims)}'), ('scenes', str(len(results)))],
        groups,
    )
    path.write_text(render(page))
    return path


def rounded(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with numbers as one reads them."""
    return [
        {key: f'{value:.3g}' if isinstance(value, float) else value for key, value in row.items()}
        for row in rows
    ]


def curve_figure(curve: Sequence[dict[str, Any]]) -> go.Figure:
    """Precision and recall over the threshold of confidence."""
    import plotly.graph_objects as go

    thresholds = [point['threshold'] for point in curve]
    figure = go.Figure()
    for name, colour in (('precision', '#c0392b'), ('recall', '#2457a6')):
        figure.add_scatter(
            x=thresholds, y=[point[name] for point in curve], name=name, line={'color': colour}
        )
    figure.add_hline(y=0.9, line={'width': 1, 'dash': 'dot', 'color': INK})
    figure.update_xaxes(title_text='confidence of a cluster, at least')
    figure.update_yaxes(range=[0, 1.05])
    figure.update_layout(legend={'orientation': 'h', 'y': 1.02, 'yanchor': 'bottom', 'x': 0})
    return styled(figure, 320, top=40)


def scene_figure(result: SceneResult) -> go.Figure:
    """Draw the fused scene, the clusters found in it, and outlines of what truly differs."""
    import plotly.graph_objects as go

    x, y, z = result.fused.astype(np.float32).T
    figure = go.Figure(
        go.Scatter3d(
            x=x,
            y=y,
            z=z,
            mode='markers',
            name='reconstructed',
            hoverinfo='skip',
            marker={'size': 1.6, 'color': x, 'colorscale': 'Viridis'},
        )
    )
    for cluster in result.clusters:
        points = cluster.points[:: max(1, len(cluster.points) // CLUSTER_POINTS)]
        u, v, w = points.astype(np.float32).T
        sure = cluster.confidence >= AnomalySettings().min_confidence
        figure.add_scatter3d(
            x=u,
            y=v,
            z=w,
            mode='markers',
            name=f'{cluster.kind}, {cluster.confidence:.2f}',
            marker={'size': 3, 'color': COLOURS[cluster.kind]},
            visible=True if sure else 'legendonly',
            showlegend=sure,
        )
    for truth in result.truth:
        figure.add_trace(_outline(truth.vertices, COLOURS[truth.kind]))
    hidden = {'visible': False}
    figure.update_layout(
        scene={
            'aspectmode': 'data',
            'xaxis': hidden,
            'yaxis': hidden,
            'zaxis': hidden,
            'camera': {'eye': {'x': -0.75, 'y': -0.75, 'z': 0.4}},
        },
        margin={'l': 0, 'r': 0, 't': 0, 'b': 0},
        height=520,
        legend={'orientation': 'h', 'y': 0, 'x': 0, 'itemsizing': 'constant'},
    )
    return figure


def _outline(vertices: np.ndarray, colour: str) -> go.Scatter3d:
    """Draw the edges of the bounding box of vertices (V, 3)."""
    import plotly.graph_objects as go

    low, high = vertices.min(axis=0) - 0.01, vertices.max(axis=0) + 0.01
    walk = [0, 1, 3, 2, 0, 4, 5, 7, 6, 4, 5, 1, 3, 7, 6, 2]  # passes every edge of a cube
    corners = np.array([[low, high][(n >> k) & 1][k] for n in walk for k in range(3)])
    x, y, z = corners.reshape(-1, 3).astype(np.float32).T
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        mode='lines',
        line={'color': colour, 'width': 3},
        showlegend=False,
        hoverinfo='skip',
    )
