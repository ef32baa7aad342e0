"""Bodies and what stands beside them, drawn by VTK: one window off screen, one camera without perspective."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkRenderWindow

from msmpetsc.errors import InputError
from msmpetsc.view.annotations import labelled, rounded
from msmpetsc.view.camera import Camera
from msmpetsc.view.colours import (
    ARROW,
    BODY,
    BOX,
    FIXED,
    GLASS,
    GLASS_EDGE,
    GROUND,
    SHADOW,
    rgb,
)
from msmpetsc.view.mesh import HELD, THROUGH, LatticeMesh
from msmpetsc.view.overlays import Ground, Overlays

GLASS_OPACITY = 0.22
FADING, AROUND = np.append(0, np.linspace(0.55, 1, 10)), 72  # radii of the rings of a ground, of the last; corners
# of a box: four along z, y and x each, between corners 4i + 2j + k
EDGES = np.array([(0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7)])
LABEL_GAP = 8  # [px] between an edge and what is written at it


@dataclass(frozen=True)
class Panel:
    """One moment: surface points (v, 3) [m], how far each is fixed (v,) in [0, 1], and what stands beside them.

    colours : (v, 3) of the points where they are not fixed, 0 to 255; those of a plain body if None
    lattice  : cells and springs
    axes    : corners (2, 3) of the box that axes are drawn around [m]
    """

    points: np.ndarray
    fixed: np.ndarray
    overlays: Overlays
    caption: tuple[str, str]
    colours: np.ndarray | None = None
    lattice: tuple[LatticeMesh, ...] = ()
    axes: np.ndarray | None = None


class Renderer:
    """A window off screen in which panels are drawn, one after the other.

    Used as a context, which closes it.
    """

    def __init__(self, width: int, height: int, triangles: np.ndarray):
        """Open a window of so many pixels for a surface of triangles (f, 3)."""
        self._size, self._triangles = np.array([width, height]), triangles
        self._front = np.zeros(3)
        with quiet_opengl():
            self._plotter = pv.Plotter(off_screen=True, window_size=[width, height], lighting="none")
            self._plotter.background_color = pv.Color("white")
            for position, intensity in (((-0.5, 1.1, 1.3), 0.85), ((1, 0.15, 0.65), 0.35)):
                self._plotter.add_light(pv.Light(position=position, intensity=intensity, light_type="camera light"))
            self._plotter.enable_anti_aliasing("ssaa")

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        with quiet_opengl():
            self._plotter.close()

    def face(self, camera: Camera, middle: np.ndarray, height: float, depth: float) -> None:
        """Face `middle` (3,) without perspective; the window shows `height` [m], and nothing beyond `depth` [m]."""
        view, far = self._plotter.camera, 4 * depth
        view.focal_point, view.position, view.up = middle, middle + far * camera.to_eye, camera.upward
        view.enable_parallel_projection()
        view.parallel_scale = height / 2
        view.clipping_range = (far / 100, 2 * far)
        self._front = 2 * depth * camera.to_eye  # out of what could hide anything
        self._to_pixels = lambda points: (
            camera.flat(points - middle) * [1, -1] * self._size[1] / height + self._size / 2
        )

    def picture(self, panel: Panel) -> np.ndarray:
        """Return the picture (height, width, 3) of a panel. Raises InputError if the graphics library gives none."""
        with quiet_opengl():
            self._plotter.suppress_rendering = True  # or all that is added would be drawn once more, half done
            self._plotter.clear_actors()
            _draw_panel(self._plotter, panel, self._triangles, self._front)
            if panel.axes is not None:
                _draw_box(self._plotter, panel.axes)
            self._plotter.suppress_rendering = False
            self._plotter.render()
            picture = self._plotter.screenshot(return_img=True)
        if picture is None or not picture.any():
            raise InputError("nothing can be drawn: the graphics library gives a black picture")
        return picture if panel.axes is None else labelled(picture, self._labels(panel.axes))

    def _labels(self, box: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Return what is written at three edges of a box (2, 3): its extent along each, with place and way out."""
        labels = []
        middles = self._to_pixels(corners_of(box)[EDGES].mean(axis=1)).reshape(3, 4, 2)  # of those along z, y and x
        outward = middles - self._to_pixels(box.mean(axis=0)[None])
        for axis, ways, ends in zip((2, 1, 0), outward, middles, strict=True):
            farthest = int(np.argmax(np.linalg.norm(ways, axis=1)))
            way = ways[farthest] / np.linalg.norm(ways[farthest])
            low, high = rounded(*box[:, axis])
            labels.append((f"{'xyz'[axis]}: {low} to {high} m", ends[farthest] + LABEL_GAP * way, way))
        return labels


def corners_of(box: np.ndarray) -> np.ndarray:
    """Return the corners (8, 3) of a box (2, 3), numbered 4i + 2j + k."""
    return np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _draw_panel(plotter: pv.Plotter, panel: Panel, triangles: np.ndarray, front: np.ndarray) -> None:
    """Draw the body and what stands beside it; front: (3,) towards the eye, out of what could hide anything."""
    for ground in panel.overlays.grounds:
        _draw_ground(plotter, ground, panel.points, triangles)
    _draw_body(plotter, panel, triangles)
    for lattice in panel.lattice:
        _draw_lattice(plotter, lattice)
    for corners in panel.overlays.glass:
        _draw_glass(plotter, corners)
    for ball in panel.overlays.balls:
        sphere = pv.Sphere(ball.radius, ball.center, theta_resolution=96, phi_resolution=96)
        plotter.add_mesh(sphere, color=GLASS, opacity=GLASS_OPACITY, smooth_shading=True, ambient=0.6, diffuse=0.4)
    for solid in panel.overlays.shapes:
        surface = pv.PolyData.from_regular_faces(solid.surface.points + solid.by, solid.surface.triangles)
        look: dict[str, Any] = dict(smooth_shading=True, split_sharp_edges=True, ambient=0.42, diffuse=0.62)
        plotter.add_mesh(surface, color=GLASS, **look)
    shape: dict[str, Any] = dict(tip_length=0.36, tip_radius=0.12, shaft_radius=0.045)
    shape |= dict(tip_resolution=40, shaft_resolution=40)
    for tail, tip in panel.overlays.arrows:  # without perspective, nearer to the eye is the same point of the picture
        length = float(np.linalg.norm(tip - tail))
        arrow = pv.Arrow(start=tail + front, direction=tip - tail, scale=length, **shape)
        plotter.add_mesh(arrow, color=ARROW, smooth_shading=True, split_sharp_edges=True, ambient=0.7, diffuse=0.4)


def _draw_body(plotter: pv.Plotter, panel: Panel, triangles: np.ndarray) -> None:
    fixed = (panel.fixed > HELD)[triangles].all(axis=1)
    shading: dict[str, Any] = dict(smooth_shading=True, ambient=0.42, diffuse=0.62, specular=0.08)
    if panel.lattice:
        shading |= dict(opacity=THROUGH)
    free: dict[str, Any] = dict(color=BODY)
    if panel.colours is not None:
        free = dict(scalars=panel.colours.astype(np.uint8), rgb=True)
    for faces, look in ((triangles[~fixed], free), (triangles[fixed], dict(color=FIXED))):
        if len(faces):
            plotter.add_mesh(pv.PolyData.from_regular_faces(panel.points, faces), **look, **shading)


def _draw_lattice(plotter: pv.Plotter, lattice: LatticeMesh) -> None:
    if lattice.joined.shape[1] == 2:
        lines = pv.PolyData(lattice.points, lines=np.insert(lattice.joined, 0, 2, axis=1).ravel())
        plotter.add_mesh(lines, color=lattice.colour, line_width=1, lighting=False)
    else:
        faces = pv.PolyData.from_regular_faces(lattice.points, lattice.joined)
        plotter.add_mesh(faces, color=lattice.colour, ambient=0.5, diffuse=0.55)


def _draw_box(plotter: pv.Plotter, box: np.ndarray) -> None:
    """Draw the edges of a box (2, 3): VTK's own axes take a second to draw."""
    lines = pv.PolyData(corners_of(box), lines=np.insert(EDGES, 0, 2, axis=1).ravel())
    plotter.add_mesh(lines, color=BOX, line_width=1, lighting=False)


def _draw_ground(plotter: pv.Plotter, ground: Ground, points: np.ndarray, triangles: np.ndarray) -> None:
    """Draw a plane and the body's shadow on it, which shows where the body is above the ground, and how high."""
    plotter.add_mesh(_disk(ground), scalars="look", rgb=True, lighting=False)
    lift = 2e-3 * np.ptp(points, axis=0).max()  # or the two surfaces would flicker into each other
    shadow = ground.below(points) + lift * ground.normal
    plotter.add_mesh(pv.PolyData.from_regular_faces(shadow, triangles), color=SHADOW, lighting=False)


def _disk(ground: Ground) -> pv.PolyData:
    """Return the disk within a ground's corners, that fades towards its rim: colours and opacity as "look"."""
    middle, angles = ground.corners.mean(axis=0), 2 * np.pi * np.arange(AROUND) / AROUND
    halves = (ground.corners[[1, 3]] - ground.corners[0]) / 2
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ halves
    disk = pv.PolyData.from_regular_faces(
        (middle + FADING[:, None, None] * around).reshape(-1, 3),
        [[AROUND * ring + k, AROUND * ring + n, AROUND * (ring + 1) + n, AROUND * (ring + 1) + k]
         for ring in range(len(FADING) - 1) for k in range(AROUND) for n in [(k + 1) % AROUND]],
    )  # fmt: skip
    share = np.clip((1 - FADING) / (1 - FADING[1]), 0, 1)
    opacity = np.repeat(255 * share**2 * (3 - 2 * share), AROUND)
    disk["look"] = np.column_stack([np.tile(rgb(GROUND), (disk.n_points, 1)), opacity]).astype(np.uint8)
    return disk


def _draw_glass(plotter: pv.Plotter, corners: np.ndarray) -> None:
    """Draw a body of corners (8, 3) numbered 4i + 2j + k, seen through, with its edges."""
    faces = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
    solid = pv.PolyData.from_regular_faces(corners, faces)
    plotter.add_mesh(solid, color=GLASS, opacity=GLASS_OPACITY, lighting=False)
    edges = solid.extract_feature_edges(feature_angle=1)
    plotter.add_mesh(edges, color=GLASS_EDGE, line_width=2, lighting=False)


@contextmanager
def quiet_opengl() -> Iterator[None]:
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
