"""A contact sheet: some moments of a result side by side in one picture.

All panels are seen by one camera without perspective, drawn one by one and pasted: so scale and height can be compared
between them. Beside each body stand the obstacles and forces of its own time.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from PIL import Image
from vtkmodules.vtkRenderingCore import vtkRenderWindow

from msmpetsc.errors import InputError
from msmpetsc.output.drawing.camera import Camera, camera_facing
from msmpetsc.output.drawing.overlays import MARGIN, Ground, Overlays, Rest, fixed_nodes, overlays_at
from msmpetsc.output.reader import Result, plain_damage
from msmpetsc.scene.schema import SceneFile

BODY, FIXED, ARROW, INK = "#8fabc6", "#46566b", "#cf5a3c", "#333a42"
GROUND, GROUND_EDGE, SHADOW = "#efece6", "#b9b3a6", "#cdc7bb"
GLASS, GLASS_EDGE, GLASS_OPACITY = "#a3b6c4", "#667e90", 0.22
PANEL_WIDTH, PANEL_HEIGHT, NARROWEST = 460, 1000, 240  # [px]: at most, and the least that a caption needs
CAPTION = 94  # [px]
WIDEST = 32767  # [px]: where 16 bits end, and with them what many programs show
DRAWN = ("lattice/cells", "surface/points", "surface/triangles", "frames/kinetic", "frames/elastic", "frames/potential")
FARTHEST = 1e15  # [m]: what is drawn has single precision, and its squares must be numbers, too
COUNT = 5  # moments, where nothing is said


@dataclass(frozen=True)
class Panel:
    """One moment: surface points (v, 3) [m], how far each is fixed (v,) in [0, 1], and what stands beside them."""

    points: np.ndarray
    fixed: np.ndarray
    overlays: Overlays
    caption: tuple[str, str]


def contact_sheet(
    h5_path: str | Path,
    png_path: str | Path,
    frames: Sequence[int] | None = None,
    count: int | None = None,
    eye: Sequence[float] | None = None,
) -> Path:
    """Draw the surface at some moments of a result; return png_path.

    frames : these, or (count) as many as `choose_moments` finds, or those at the scene's picture.times
    eye    : direction from the body to the eye (3,); the scene's picture.eye if None
    """
    with plain_damage(Path(h5_path)), Result(h5_path) as run:
        scene = read_scene(run)
        refuse_what_cannot_be_drawn(run, scene)
        moments = _moments(run, scene, frames, count)
        bodies = {index: surface_points(run, index) for index in moments}
        everywhere = np.concatenate(list(bodies.values()))
        if not (np.abs(everywhere) < FARTHEST).all() or np.ptp(everywhere, axis=0).max() == 0:
            raise InputError(f"{h5_path}: the surface at these moments has no extent, or none that can be drawn")
        gravity = scene.gravity.acceleration if scene.gravity else None
        camera = camera_facing(everywhere, gravity, scene.picture.eye if eye is None else eye)
        rest = Rest(run.lattice.nodes[:], run.lattice.cells[:], run.surface.points[:])
        panels = []
        for index, points in bodies.items():
            time = float(run.frames.time[index])
            overlays = overlays_at(scene, time, rest, run.frames.position[index], everywhere, camera)
            caption = f"t = {time:.3f} s", moments[index]
            panels.append(Panel(points, _on_surface(run, fixed_nodes(scene, time, rest)), overlays, caption))
        triangles = run.surface.triangles[:]
    draw(panels, triangles, camera, Path(png_path))
    return Path(png_path)


def refuse_what_cannot_be_drawn(run: Result, scene: SceneFile) -> None:
    """Raise InputError unless what is drawn is there, of matching shapes, and names points and nodes that exist."""
    if "embedding/weights" not in run:
        raise InputError(f"{run.path} has no surface to draw: its scene says output.surface = false")
    nodes, points = len(run["lattice/nodes"]), len(run["surface/points"])
    for name in DRAWN:
        _ = run[name]  # which must be there
    for name, count in {"lattice/cells": nodes, "surface/triangles": points}.items():
        numbers = run[name][:]
        if numbers.size == 0 or not 0 <= numbers.min() <= numbers.max() < count:
            raise InputError(f"{run.path} is damaged: {name} is empty, or names what is not among its {count}")
    regions = [table.region.painted for tables in (scene.pin, scene.anchor, scene.force) for table in tables]
    if any(max(painted) >= points for painted in regions if isinstance(painted, tuple)):
        raise InputError(f"{run.path} is damaged: its scene names painted points beyond its {points}")
    if not (np.abs(run["lattice/nodes"][:]) < FARTHEST).all() or not np.isfinite(run["embedding/weights"][:]).all():
        raise InputError(f"{run.path} is damaged: its lattice or its embedding has numbers that are none")
    _ = run.embedding  # which checks itself


def read_scene(run: Result) -> SceneFile:
    """Return the scene of a result, as run, with its keys checked."""
    try:
        return SceneFile.model_validate(run.scene)
    except (InputError, ValueError, TypeError, AttributeError, RecursionError) as error:  # pydantic's among them
        raise InputError(f"{run.path} was run by another version, with a scene unknown to this one") from error


def _moments(run: Result, scene: SceneFile, frames: Sequence[int] | None, count: int | None) -> dict[int, str]:
    """Return the frames to draw, each with its reason or ""."""
    total = len(run.frames.time)
    if total == 0:
        raise InputError(f"{run.path} has no finished frame")
    refuse_wide(len(set(frames)) if frames else min(count or 0, total))  # before the surfaces of all are read
    if frames:
        moments = dict.fromkeys(frames, "")
    elif count is None and scene.picture.times:
        moments = moments_at(run, scene.picture.times)
    else:
        moments = choose_moments(run, count or COUNT)
    outside = [index for index in moments if not 0 <= index < total]
    if outside:
        raise InputError(f"{run.path} has frames 0 to {total - 1}, not {outside[0]}")
    return moments


def moments_at(run: Result, times: Sequence[float]) -> dict[int, str]:
    """Return the start, and the finished frames nearest to these times [s], in order of time."""
    time = run.frames.time[:]
    nearest = {0, *(int(np.argmin(abs(time - wanted))) for wanted in times)}
    return {index: "" if index else "start" for index in sorted(nearest)}


def choose_moments(run: Result, count: int) -> dict[int, str]:
    """Return at most `count` frames that tell the story, in order of time, each with its reason.

    In order of importance: the first and the last; the greatest elastic energy; before it the greatest kinetic
    energy (a falling body is fastest just before it touches the ground); after it the greatest potential energy
    (the top of the leap). Where these coincide, the middle of the longest gap between chosen frames is added.
    """
    kinetic, elastic, potential = (run.frames[name][:] for name in ("kinetic", "elastic", "potential"))
    total = len(elastic)
    most_elastic = int(np.argmax(elastic))
    fastest = int(np.argmax(kinetic[: most_elastic + 1]))
    highest = most_elastic + int(np.argmax(potential[most_elastic:]))
    moments = {0: "start", total - 1: "end"}
    for index, reason in (most_elastic, "most elastic energy"), (fastest, "fastest"), (highest, "highest"):
        if len(moments) < count:
            moments.setdefault(index, reason)
    while len(moments) < min(count, total):
        chosen = sorted(moments)
        widest = int(np.argmax(np.diff(chosen)))
        moments[(chosen[widest] + chosen[widest + 1]) // 2] = ""
    return dict(sorted(moments.items())[:count])


def surface_points(run: Result, index: int) -> np.ndarray:
    """Return the surface points (v, 3) of a frame [m]: as stored, or W @ positions."""
    if "frames/surface" in run:
        return run.frames.surface[index].astype(float)
    return run.embedding @ run.frames.position[index]


def _on_surface(run: Result, nodes: np.ndarray) -> np.ndarray:
    """Return how far each surface point follows these nodes (n,) bool: (v,) in [0, 1]."""
    if not nodes.any():
        return np.zeros(len(run.surface.points))
    return np.clip(run.embedding @ nodes.astype(float), 0, 1)


def draw(panels: list[Panel], triangles: np.ndarray, camera: Camera, path: Path) -> None:
    """Render the panels one by one, each with its caption, and paste them from left to right.

    A graphics library's own pictures end at some width, and beyond it they are black.
    """
    low, high = _frame(panels, camera)
    scale = min(PANEL_WIDTH / (high - low)[0], PANEL_HEIGHT / (high - low)[1])  # [px/m]
    width, height = np.maximum([NARROWEST, 1], np.round(scale * (high - low))).astype(int)  # [px]
    refuse_wide(len(panels), int(width))
    shown = np.concatenate([points for panel in panels for points in (panel.points, panel.overlays.corners)])
    depth = float(np.linalg.norm(np.ptp(shown, axis=0)))  # nothing reaches farther towards the eye
    across, upward = (low + high) / 2 - [0, CAPTION / 2 / scale]
    middle = across * camera.right + upward * camera.upward + shown[0] @ camera.to_eye * camera.to_eye
    sheet = np.empty((height + CAPTION, width * len(panels), 3), np.uint8)
    with _quiet_opengl():
        for number, panel in enumerate(panels):
            plotter = pv.Plotter(off_screen=True, window_size=[width, height + CAPTION], lighting="none")
            plotter.background_color = pv.Color("white")
            _draw_panel(plotter, panel, triangles, 2 * depth * camera.to_eye)
            _write_caption(plotter, panel.caption, width / 2)
            _set_eye(plotter, camera, middle, (height + CAPTION) / scale, 4 * depth)
            plotter.enable_anti_aliasing("ssaa")
            picture = plotter.screenshot(return_img=True)
            plotter.close()
            if picture is None or not picture.any():
                raise InputError(f"{path} cannot be drawn: the graphics library gives a black picture")
            sheet[:, number * width : (number + 1) * width] = picture
    _save(sheet, path)


def refuse_wide(panels: int, width: int = NARROWEST) -> None:
    """Raise InputError for a picture of so many panels of this width [px], or more, that few programs would show."""
    if panels * width > WIDEST:
        raise InputError(
            f"{panels} moments are too many for one picture: of panels {width} pixels wide "
            f"at most {WIDEST // width} fit into {WIDEST}"
        )


def _save(picture: np.ndarray, path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error


def _frame(panels: list[Panel], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return lower left and upper right (2,), (2,) [m] of what every panel shows, in the picture's plane."""
    bodies = np.concatenate([panel.points for panel in panels])
    margin = MARGIN * np.ptp(bodies, axis=0).max()
    sharp = [points for panel in panels for points in (*panel.overlays.glass, *panel.overlays.arrows)]
    inner = camera.flat(np.concatenate([bodies, *sharp]))
    grounds = [camera.flat(ground.corners) for panel in panels for ground in panel.overlays.grounds]
    rows = np.concatenate([inner - margin, inner + margin, *grounds])
    return rows.min(axis=0), rows.max(axis=0)


def _draw_panel(plotter: pv.Plotter, panel: Panel, triangles: np.ndarray, front: np.ndarray) -> None:
    """Draw the body and what stands beside it; front: (3,) towards the eye, out of what could hide anything."""
    for ground in panel.overlays.grounds:
        _draw_ground(plotter, ground, panel.points, triangles)
    body = pv.PolyData.from_regular_faces(panel.points, triangles)
    colours = (1 - panel.fixed[:, None]) * _rgb(BODY) + panel.fixed[:, None] * _rgb(FIXED)
    shading: dict[str, Any] = dict(smooth_shading=True, ambient=0.42, diffuse=0.62, specular=0.08)
    plotter.add_mesh(body, scalars=colours.astype(np.uint8), rgb=True, **shading)
    for corners in panel.overlays.glass:
        _draw_glass(plotter, corners)
    shape: dict[str, Any] = dict(tip_length=0.36, tip_radius=0.12, shaft_radius=0.045)
    shape |= dict(tip_resolution=40, shaft_resolution=40)
    for tail, tip in panel.overlays.arrows:  # without perspective, nearer to the eye is the same point of the picture
        length = float(np.linalg.norm(tip - tail))
        arrow = pv.Arrow(start=tail + front, direction=tip - tail, scale=length, **shape)
        plotter.add_mesh(arrow, color=ARROW, smooth_shading=True, split_sharp_edges=True, ambient=0.7, diffuse=0.4)


def _draw_ground(plotter: pv.Plotter, ground: Ground, points: np.ndarray, triangles: np.ndarray) -> None:
    """Draw a plane and the body's shadow on it, which shows where the body is above the ground, and how high."""
    patch = pv.PolyData.from_regular_faces(ground.corners, [[0, 1, 2, 3]])
    plotter.add_mesh(patch, color=GROUND, lighting=False, show_edges=True, edge_color=GROUND_EDGE, line_width=2)
    above = (points - ground.corners[0]) @ ground.normal
    lift = 2e-3 * np.ptp(points, axis=0).max()  # or the two surfaces would flicker into each other
    shadow = points - np.outer(above - lift, ground.normal)
    plotter.add_mesh(pv.PolyData.from_regular_faces(shadow, triangles), color=SHADOW, lighting=False)


def _draw_glass(plotter: pv.Plotter, corners: np.ndarray) -> None:
    """Draw a body of corners (8, 3) numbered 4i + 2j + k, seen through, with its edges."""
    faces = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
    solid = pv.PolyData.from_regular_faces(corners, faces)
    plotter.add_mesh(solid, color=GLASS, opacity=GLASS_OPACITY, lighting=False)
    edges = solid.extract_feature_edges(feature_angle=1)
    plotter.add_mesh(edges, color=GLASS_EDGE, line_width=2, lighting=False)


def _rgb(colour: str) -> np.ndarray:
    return np.array(pv.Color(colour).int_rgb, float)


def _write_caption(plotter: pv.Plotter, caption: tuple[str, str], middle: float) -> None:
    """Write time and reason below a panel whose middle is `middle` [px]."""
    for text, size, height in zip(caption, (15, 11), (42, 16), strict=True):
        if text:
            actor = plotter.add_text(text, position=(middle, height), font_size=size, color=INK)
            actor.prop.justification_horizontal = "center"


def _set_eye(plotter: pv.Plotter, camera: Camera, middle: np.ndarray, height: float, far: float) -> None:
    """Look without perspective at `middle` (3,) of a picture that is `height` [m] high, from `far` [m] away."""
    view = plotter.camera
    view.focal_point, view.position, view.up = middle, middle + far * camera.to_eye, camera.upward
    view.enable_parallel_projection()
    view.parallel_scale = height / 2
    view.clipping_range = (far / 100, 2 * far)
    for position, intensity in (((-0.5, 1.1, 1.3), 0.85), ((1, 0.15, 0.65), 0.35)):
        plotter.add_light(pv.Light(position=position, intensity=intensity, light_type="camera light"))


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
