"""A contact sheet: some moments of a result side by side in one picture.

All bodies stand in one scene, seen by one camera without perspective, each shifted to the right by one panel: so
scale and height can be compared between them. Lengths here are in the camera's own axes, x to the right, y away
from the eye, z up, unless said otherwise.
"""

import os
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pyvista as pv
from PIL import Image
from scipy.sparse import csr_array
from vtkmodules.vtkRenderingCore import vtkRenderWindow

from msmpetsc.errors import InputError
from msmpetsc.output.frames import finished, open_result

BODY, GROUND, GROUND_EDGE, SHADOW, INK = "#8fabc6", "#efece6", "#b9b3a6", "#cdc7bb", "#333a42"
YAW, ELEVATION = np.radians(25), np.radians(14)  # how far the eye stands to the side, and above
PANEL_WIDTH, PANEL_HEIGHT, NARROWEST = 460, 1000, 240  # [px]: at most, and the least that a caption needs
TO_EYE = np.array([0.0, -np.cos(ELEVATION), np.sin(ELEVATION)])
CAPTION = 76  # [px]
MARGIN = 0.08  # of the greatest extent, around the bodies


@dataclass(frozen=True)
class Plane:
    """A plane obstacle: a point of it and its unit normal, (3,) each."""

    point: np.ndarray
    normal: np.ndarray


def contact_sheet(
    h5_path: str | Path, png_path: str | Path, frames: Sequence[int] | None = None, count: int = 5
) -> Path:
    """Draw the surface at these frames, or at `count` that `choose_moments` finds; returns png_path."""
    with open_result(h5_path) as file:
        total = finished(file)
        if total == 0:
            raise InputError(f"{h5_path} has no finished frame")
        moments = dict.fromkeys(frames, "") if frames else choose_moments(file, count)
        outside = [index for index in moments if not 0 <= index < total]
        if outside:
            raise InputError(f"{h5_path} has frames 0 to {total - 1}, not {outside[0]}")
        bodies = [surface_points(file, index) for index in moments]
        captions = [(f"t = {file['frames/time'][index]:.3f} s", why) for index, why in moments.items()]
        triangles, scene = file["surface/triangles"][...], tomllib.loads(file.attrs.get("scene", ""))
    axes = camera_axes(np.concatenate(bodies), scene)
    planes = [
        Plane(axes @ obstacle["point"], axes @ _unit(obstacle["normal"]))
        for obstacle in scene.get("obstacle", [])
        if obstacle.get("shape") == "plane"
    ]
    draw([points @ axes.T for points in bodies], triangles, planes, captions, Path(png_path))
    return Path(png_path)


def choose_moments(file: h5py.File, count: int) -> dict[int, str]:
    """At most `count` frames that tell the story, in order of time, each with its reason.

    In order of importance: the first and the last; the greatest elastic energy; before it the greatest kinetic
    energy (a falling body is fastest just before it touches the ground); after it the greatest potential energy
    (the top of the leap). Where these coincide, the middle of the longest gap between chosen frames is added.
    """
    total = finished(file)
    kinetic, elastic, potential = (file["frames"][name][:total] for name in ("kinetic", "elastic", "potential"))
    most_elastic = int(np.argmax(elastic))
    fastest = int(np.argmax(kinetic[: most_elastic + 1]))
    highest = most_elastic + int(np.argmax(potential[most_elastic:]))
    moments = {0: "start", total - 1: "end"}
    told = (most_elastic, "most elastic energy"), (fastest, "fastest"), (highest, "highest")
    for index, why in told:
        if len(moments) < count:
            moments.setdefault(index, why)
    while len(moments) < min(count, total):
        chosen = sorted(moments)
        widest = int(np.argmax(np.diff(chosen)))
        moments[(chosen[widest] + chosen[widest + 1]) // 2] = ""
    return dict(sorted(moments.items())[:count])


def surface_points(file: h5py.File, index: int) -> np.ndarray:
    """(v, 3) surface points of a frame [m]: as stored, or W @ positions."""
    if "frames/surface" in file:
        return file["frames/surface"][index].astype(float)
    embedding, position = file["embedding"], file["frames/position"][index]
    parts = tuple(embedding[name][...] for name in ("weights", "indices", "indptr"))
    return csr_array(parts, shape=(len(parts[2]) - 1, len(position))) @ position


def camera_axes(points: np.ndarray, scene: dict) -> np.ndarray:
    """(3, 3): rows are the directions right, away and up of the picture in the scene's axes.

    Up is against gravity (z without it); the longer horizontal extent of the points lies across the picture.
    """
    gravity = np.array(scene.get("gravity", {}).get("acceleration", (0, 0, 0)), float)
    up = _unit(-gravity) if gravity.any() else np.array([0.0, 0.0, 1.0])
    flat = np.delete(np.eye(3), np.argmax(abs(up)), axis=0)
    flat = np.array([_unit(axis - (axis @ up) * up) for axis in flat])
    right = flat[np.argmax(np.ptp(points @ flat.T, axis=0))]
    away = np.cross(up, right)
    return np.array([np.cos(YAW) * right + np.sin(YAW) * away, np.cos(YAW) * away - np.sin(YAW) * right, up])


def draw(
    bodies: list[np.ndarray], triangles: np.ndarray, planes: list[Plane], captions: list[tuple[str, str]], path: Path
) -> None:
    """Render the bodies (v, 3), in camera axes, from left to right on their planes, with captions below."""
    low, high = _box(bodies, planes)
    size = high - low
    panel = size[0], size[2] * np.cos(ELEVATION) + size[1] * np.sin(ELEVATION)  # [m] in the picture
    scale = min(PANEL_WIDTH / panel[0], PANEL_HEIGHT / panel[1])  # [px/m]
    width, height = max(NARROWEST, round(scale * panel[0])), round(scale * panel[1]) + CAPTION  # [px]
    with _quiet_opengl():
        plotter = pv.Plotter(off_screen=True, window_size=(width * len(bodies), height), lighting="none")
        plotter.set_background("white")
        for number, points in enumerate(bodies):
            shift = np.array([number * width / scale, 0, 0])
            for plane in planes:
                _draw_plane(plotter, plane, low, high, shift)
                _draw_shadow(plotter, plane, points, triangles, shift)
            body = pv.PolyData.from_regular_faces(points + shift, triangles)
            plotter.add_mesh(body, color=BODY, smooth_shading=True, ambient=0.42, diffuse=0.62, specular=0.08)
            _write_caption(plotter, captions[number], (number + 0.5) * width)
        _set_eye(plotter, np.array([low, high + shift]), height, scale)
        plotter.enable_anti_aliasing("ssaa")
        picture = plotter.screenshot(return_img=True)
        plotter.close()
    _save(picture, path)


def _save(picture: np.ndarray, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error


def _box(bodies: list[np.ndarray], planes: list[Plane]) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), (3,) of what every panel shows: all bodies, and the planes' feet below them if not far away."""
    points = np.concatenate(bodies)
    reach = np.ptp(points, axis=0).max()
    shown = [points]
    for plane in planes:
        above = (points - plane.point) @ plane.normal
        nearest = np.argmin(above)
        if above[nearest] < reach:
            shown.append((points[nearest] - above[nearest] * plane.normal)[None])
    shown = np.concatenate(shown)
    return shown.min(axis=0) - MARGIN * reach, shown.max(axis=0) + MARGIN * reach


def _draw_plane(plotter: pv.Plotter, plane: Plane, low: np.ndarray, high: np.ndarray, shift: np.ndarray) -> None:
    """The part of the plane within a panel's box; seen from behind it would hide the body, so it is left out."""
    axis = int(np.argmax(abs(plane.normal)))  # the plane's height along it is a function of the other two
    one, two = (axis + 1) % 3, (axis + 2) % 3
    corners = np.empty((4, 3))
    corners[:, one] = low[one], high[one], high[one], low[one]
    corners[:, two] = low[two], low[two], high[two], high[two]
    rest = (corners - plane.point)[:, [one, two]] @ plane.normal[[one, two]]
    corners[:, axis] = plane.point[axis] - rest / plane.normal[axis]
    if plane.normal @ TO_EYE > 0:
        patch = pv.PolyData.from_regular_faces(corners + shift, [[0, 1, 2, 3]])
        plotter.add_mesh(patch, color=GROUND, lighting=False, show_edges=True, edge_color=GROUND_EDGE, line_width=2)


def _draw_shadow(plotter: pv.Plotter, plane: Plane, points: np.ndarray, triangles: np.ndarray, shift) -> None:
    """The body's projection on the plane: it shows where the body is above it, and how high."""
    above = (points - plane.point) @ plane.normal
    lift = 2e-3 * np.ptp(points, axis=0).max()  # or the two surfaces would flicker into each other
    shadow = points - np.outer(above - lift, plane.normal)
    if plane.normal @ TO_EYE > 0:
        plotter.add_mesh(pv.PolyData.from_regular_faces(shadow + shift, triangles), color=SHADOW, lighting=False)


def _write_caption(plotter: pv.Plotter, caption: tuple[str, str], middle: float) -> None:
    """Time and reason below a panel whose middle is `middle` [px]."""
    for text, size, height in zip(caption, (15, 11), (CAPTION - 34, CAPTION - 60)):
        if text:
            actor = plotter.add_text(text, position=(middle, height), font_size=size, color=INK)
            actor.prop.justification_horizontal = "center"


def _set_eye(plotter: pv.Plotter, box: np.ndarray, height: int, scale: float) -> None:
    """Look without perspective at the whole row of panels, box (2,3), with the captions' strip left free below."""
    middle, far = box.mean(axis=0), 10 * np.linalg.norm(box[1] - box[0])
    middle = middle - CAPTION / 2 / scale * np.cross(TO_EYE, [1.0, 0, 0])
    camera = plotter.camera
    camera.focal_point, camera.position, camera.up = middle, middle + far * TO_EYE, (0, 0, 1)
    camera.enable_parallel_projection()
    camera.parallel_scale = height / 2 / scale
    camera.clipping_range = (far / 2, 2 * far)
    for place, intensity in (((-0.5, -1, 1.4), 0.85), ((1, -0.6, 0.3), 0.35)):
        plotter.add_light(pv.Light(position=place, intensity=intensity, light_type="scene light"))


@contextmanager
def _quiet_opengl() -> Iterator[None]:
    """Keep what the graphics libraries say on their own off the terminal; InputError if there is no OpenGL."""
    terminal = os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        # With neither screen nor EGL, VTK falls back on OSMesa, which is hardly found and crashes it if absent.
        if vtkRenderWindow().IsA("vtkOSOpenGLRenderWindow"):
            raise InputError("no OpenGL to draw with: apt install libegl1 libgl1-mesa-dri")
        yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)


def _unit(vector: Sequence[float]) -> np.ndarray:
    return np.asarray(vector, float) / np.linalg.norm(vector)
