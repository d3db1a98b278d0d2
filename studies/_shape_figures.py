"""The paper's figures 5-8, redrawn from the simulated experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from studies.support.shape_curves import at_fractions

TITLES = {
    'quadratic_bezier': 'Quadratic Bezier pieces',
    'cubic_bezier': 'Cubic Bezier',
    'kasa_arc': 'Kasa arc',
}
COLOURS = {
    'quadratic_bezier': '#0072b2',
    'cubic_bezier': '#d55e00',
    'kasa_arc': '#009e73',
    'straight': '#0072b2',
    '160 mm': '#d55e00',
    '80 mm': '#009e73',
}
COMPARED = '160 mm'


def draw(data: dict[str, dict[str, Any]], out: Path) -> None:
    """Write figure5.png to figure8.png into `out`; `data` is `figure_data` of the study."""
    import matplotlib

    matplotlib.use('Agg')
    _curves_of_methods(data[COMPARED], out / 'figure5.png')
    _errors_of_methods(data[COMPARED], out / 'figure6.png')
    _curves_of_grooves(data, out / 'figure7.png')
    _errors_of_grooves(data, out / 'figure8.png')


def _panels(count: int, height: float = 3.6) -> tuple[Any, Any]:
    import matplotlib.pyplot as plt

    return plt.subplots(
        1, count, figsize=(3.6 * count, height), layout='constrained', squeeze=False
    )


def _finish(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure.savefig(path, dpi=150)
    plt.close(figure)


def _plane(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(N, 2) mm: sideways in the truth's bending plane, and along the magnet's axis."""
    sideways = truth[-1, 1:]
    size = np.linalg.norm(sideways)
    direction = sideways / size if size > 1e-6 else np.array([0.0, 1.0])
    return 1e3 * np.column_stack([points[:, 1:] @ direction, points[:, 0]])


def _shape(axis: Any, groove: dict[str, Any], method: str) -> None:
    truth = groove['truth']
    styles = (
        ('mended', '#e69f00', ':', "paper's pipeline, mended"),
        ('ours', COLOURS[method], '-', 'estimate'),
    )
    axis.plot(
        *_plane(truth, truth).T, color='0.75', linewidth=6, solid_capstyle='butt', label='truth'
    )
    for key, colour, line, label in styles:
        axis.plot(
            *_plane(groove[key][method], truth).T, line, color=colour, linewidth=1.8, label=label
        )
    axis.plot(*_plane(groove['points'], truth).T, 'k.', markersize=8, label='magnet and modules')
    axis.set(xlabel='sideways [mm]', ylabel="along the magnet's axis [mm]")
    axis.set_aspect('equal', adjustable='datalim')


def _curves_of_methods(groove: dict[str, Any], path: Path) -> None:
    figure, axes = _panels(len(TITLES), 4.0)
    for axis, (method, title) in zip(axes[0], TITLES.items(), strict=True):
        _shape(axis, groove, method)
        axis.set_title(title, fontsize=11)
    axes[0, 0].legend(fontsize=8, loc='lower right')
    figure.suptitle(f'{COMPARED} groove, calibrated')
    _finish(figure, path)


def _error_panel(
    axis: Any, groove: dict[str, Any], method: str, key: str, colour: str, label: str
) -> None:
    fractions = np.linspace(0.0, 1.0, len(groove['truth']))
    error = 1e3 * np.linalg.norm(
        at_fractions(groove[key][method], fractions) - groove['truth'], axis=1
    )
    axis.plot(75.0 * fractions, error, color=colour, label=f'{label}, MAE {error.mean():.3f} mm')


def _labelled(figure: Any, axes: Any, titles: tuple[str, ...], path: Path) -> None:
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xlabel='arclength [mm]', ylabel='error [mm]')
        axis.set_title(title, fontsize=10)
        axis.set_ylim(0.0, 1.35 * axis.get_ylim()[1])  # room for the legend
        axis.legend(fontsize=7, loc='upper left')
        axis.grid(alpha=0.3)
    _finish(figure, path)


PIPELINES = {
    'ours': 'calibrated',
    'mended': "the paper's, mended",
    'printed': "the paper's, as printed",
}


def _errors_of_methods(groove: dict[str, Any], path: Path) -> None:
    figure, axes = _panels(len(PIPELINES))
    for axis, key in zip(axes[0], PIPELINES, strict=True):
        for method, title in TITLES.items():
            _error_panel(axis, groove, method, key, COLOURS[method], title)
    _labelled(
        figure, axes[0], tuple(f'{COMPARED} groove: {name}' for name in PIPELINES.values()), path
    )


def _curves_of_grooves(data: dict[str, dict[str, Any]], path: Path) -> None:
    figure, axes = _panels(len(data), 4.0)
    for axis, (name, groove) in zip(axes[0], data.items(), strict=True):
        _shape(axis, groove, 'kasa_arc')
        axis.set_title(
            f'{name} groove' if name == 'straight' else f'groove of {name}', fontsize=11
        )
    axes[0, 1].legend(fontsize=8, loc='lower right')
    figure.suptitle('Kasa arc, calibrated')
    _finish(figure, path)


def _errors_of_grooves(data: dict[str, dict[str, Any]], path: Path) -> None:
    figure, axes = _panels(len(PIPELINES))
    for axis, key in zip(axes[0], PIPELINES, strict=True):
        for name, groove in data.items():
            _error_panel(axis, groove, 'kasa_arc', key, COLOURS[name], name)
    _labelled(figure, axes[0], tuple(f'Kasa arc, {name}' for name in PIPELINES.values()), path)
