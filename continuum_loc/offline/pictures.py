"""
A still and a moving picture of a run.

On the left the world as it is, on the right what the robot makes of it.
"""

from __future__ import annotations

from pathlib import Path

from continuum_loc import lie
from continuum_loc.measurements import NANOSECONDS
from continuum_loc.offline.metrics import errors
from continuum_loc.offline.report import Context, context_of
from continuum_loc.offline.runs import load_run, Run
from continuum_loc.offline.view import recent_points, swept_box
from continuum_loc.robot import RobotDescription
from continuum_loc.simulator.render import Camera, render, robot_shapes, Shape
import numpy as np

PANEL = (560, 380)
FRAMES, FRAME_MS = 40, 120
MAP_POINTS, CLOUD_POINTS, REACH = 25_000, 900, 0.45
MESH, MAP, CLOUD = (0.62, 0.70, 0.78), (0.62, 0.69, 0.77), (0.02, 0.62, 0.58)
SECTIONS = 10  # tube sections between two rings


def draw(folder: Path, stem: Path) -> list[Path]:
    """Write STEM.png (the middle of the run) and STEM.gif, and return their paths."""
    from PIL import Image

    run = load_run(folder)
    painter = Painter(run, context_of(run))
    chosen = np.linspace(0, len(run.result.track) - 1, FRAMES).round().astype(int)
    images = [Image.fromarray(painter.picture(index)) for index in chosen]
    stem.parent.mkdir(parents=True, exist_ok=True)
    still, moving = stem.with_suffix('.png'), stem.with_suffix('.gif')
    Image.fromarray(painter.picture(chosen[len(chosen) * 2 // 3])).save(still, optimize=True)
    palette = images[len(images) // 2].quantize(96)
    small = [
        image.resize(
            (image.width * 3 // 4, image.height * 3 // 4), Image.Resampling.LANCZOS
        ).quantize(palette=palette, dither=Image.Dither.NONE)
        for image in images
    ]
    small[0].save(
        moving, save_all=True, append_images=small[1:], duration=FRAME_MS, loop=0, optimize=True
    )
    return [still, moving]


class Painter:
    """Draws one instant of a run; what stays the same is prepared once."""

    def __init__(self, run: Run, context: Context) -> None:
        self.run = run
        self.robot = RobotDescription.model_validate(run.configuration['robot'])
        self.camera = camera_on(*swept_box(run.result, 0.0))
        low, high = swept_box(run.result, REACH)
        points = context.map_points if context.map_points is not None else np.empty((0, 3))
        points = points[
            np.all((points > low) & (points < high), axis=1) & (points[:, 1] > self.camera.section)
        ]
        self.map = dots(points[:: max(1, len(points) // MAP_POINTS)], 0.005, MAP)
        self.mesh = [Shape(*context.mesh, MESH)] if context.mesh is not None else []
        self.error = errors(run.result.track, run.result.truth)

    def picture(self, index: int) -> np.ndarray:
        """(H, 2 W, 3) uint8: both panels at the track's instant `index`."""
        result = self.run.result
        stamp = int(result.track.stamps[index])
        true = (
            result.truth.at(np.array([stamp]))[0]
            if self._known(stamp)
            else result.track.T_map_ring[index]
        )
        points = dots(recent_points(result.cloud, stamp, CLOUD_POINTS), 0.012, CLOUD)
        left = render([*self.mesh, *self._body(true)], self.camera)
        right = render(
            [self.map, points, *self._body(result.track.T_map_ring[index])], self.camera
        )
        return _captioned(left, right, self._caption(stamp))

    def _body(self, T_map_ring: np.ndarray) -> list[Shape]:
        return robot_shapes(self.robot, between_rings(T_map_ring), T_map_ring[1:])

    def _known(self, stamp: int) -> bool:
        truth = self.run.result.truth
        return len(truth) > 1 and truth.stamps[0] <= stamp <= truth.stamps[-1]

    def _caption(self, stamp: int) -> str:
        time = (stamp - int(self.run.result.track.stamps[0])) / NANOSECONDS
        at = np.flatnonzero(self.error.stamps == stamp)
        said = (
            f', error {100 * self.error.translation_m[at[0], 1:].mean():.2f} cm' if len(at) else ''
        )
        return f'localised from time-of-flight, gyros and strain: t = {time:.1f} s{said}'


def between_rings(T_map_ring: np.ndarray) -> np.ndarray:
    """(N, 4, 4) frames along the body, of constant strain between base and rings (R + 1, 4, 4)."""
    share = np.arange(SECTIONS) / SECTIONS
    frames = lie.interpolate(
        T_map_ring[:-1, None],
        T_map_ring[1:, None],
        np.broadcast_to(share, (len(T_map_ring) - 1, SECTIONS)),
    )
    return np.concatenate([frames.reshape(-1, 4, 4), T_map_ring[-1:]])


def dots(points: np.ndarray, radius: float, colour: tuple[float, float, float]) -> Shape:
    """Put an octahedron of `radius` [m] at each of the points (N, 3)."""
    corners = radius * np.array(
        [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float
    )
    sides = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    )
    vertices = (points[:, None] + corners).reshape(-1, 3)
    faces = (6 * np.arange(len(points))[:, None, None] + sides).reshape(-1, 3)
    return Shape(vertices, faces, colour)


def camera_on(low: np.ndarray, high: np.ndarray) -> Camera:
    """
    Look from the side (against y) and a little above, so that the swept box fills the picture.

    What lies before the body is cut away.
    """
    middle, size = 0.5 * (low + high), np.maximum(high - low, 0.2)
    width, height = PANEL
    distance = 0.6 * max(size[0], size[2] * width / height) / np.tan(np.radians(25.0))
    eye = middle + distance * np.array([-0.25, -1.0, 0.25])
    return Camera(
        tuple(eye), tuple(middle), fov_deg=50.0, width=width, height=height, section=low[1] - 0.05
    )


def _captioned(left: np.ndarray, right: np.ndarray, caption: str) -> np.ndarray:
    from PIL import Image, ImageDraw, ImageFont

    height, width = left.shape[:2]
    sheet = Image.new('RGB', (2 * width + 8, height + 26), 'white')
    sheet.paste(Image.fromarray(left), (0, 26))
    sheet.paste(Image.fromarray(right), (width + 8, 26))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    pen.text((6, 4), 'the world, simulated', fill=(31, 41, 51), font=font)
    pen.text((width + 14, 4), caption, fill=(31, 41, 51), font=font)
    return np.asarray(sheet)
