"""Rendering of bodies, obstacles and arrows with VTK, off screen, by an orthographic camera."""

import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
import pyvista as pv
from vtkmodules.vtkRenderingCore import vtkRenderWindow

from msmpetsc.backend.arrays import Array, Floats
from msmpetsc.errors import InputError
from msmpetsc.view.colours import ARROW, FIXED, GLASS, GLASS_EDGE, GROUND, SHADOW
from msmpetsc.view.composition import Composition, Still
from msmpetsc.view.mesh import KINDS, surface_of
from msmpetsc.view.overlays import Ground, Overlays

GLASS_OPACITY = 0.22
SHADING: dict[str, Any] = dict(smooth_shading=True, ambient=0.42, diffuse=0.62)
# share of a ground's radius from which it fades, and number of corners of its rim
FADING, RIM_CORNERS = 0.55, 72


class Renderer(AbstractContextManager["Renderer"]):
    """An off-screen window that draws stills, and a context manager that closes the window."""

    def __init__(self, composition: Composition, stills: Sequence[Still], size: tuple[int, int]):
        """Open a window of width and height [px] whose view contains all stills."""
        self._composition = composition
        low, high, self._depth = composition.room(stills)
        # height of the view [m]
        height = size[1] * ((high - low) / size).max()
        with quiet_opengl():
            self._plotter = pv.Plotter(off_screen=True, window_size=list(size), lighting="none")
            self._plotter.background_color = pv.Color("white")
            for position, intensity in (((-0.5, 1.1, 1.3), 0.85), ((1, 0.15, 0.65), 0.35)):
                self._plotter.add_light(
                    pv.Light(position=position, intensity=intensity, light_type="camera light")
                )
            self._plotter.enable_anti_aliasing("ssaa")
            self._face((low + high) / 2, height)

    def __exit__(self, *_: object) -> None:
        with quiet_opengl():
            self._plotter.close()

    def picture(self, still: Still) -> Array:
        """Return the picture (height, width, 3) of a still. Raises InputError if it is black."""
        with quiet_opengl():
            # otherwise the window would be rendered for each added mesh
            self._plotter.suppress_rendering = True
            self._plotter.clear_actors()
            self._draw(still)
            self._plotter.suppress_rendering = False
            self._plotter.render()
            picture = self._plotter.screenshot(return_img=True)
        if picture is None or not picture.any():
            raise InputError("nothing can be drawn: the graphics library gives a black picture")
        return np.asarray(picture)

    def _face(self, centre: Floats, height: float) -> None:
        """Aim the camera at a point (2,) of the picture's plane; ``height`` [m] is in view."""
        camera = self._composition.camera
        view = self._plotter.camera
        distance = 4 * self._depth
        across, upward = centre
        behind = self._composition.box.mean(axis=0) @ camera.to_eye
        middle = across * camera.right + upward * camera.upward + behind * camera.to_eye
        view.focal_point = middle
        view.position = middle + distance * camera.to_eye
        view.up = camera.upward
        view.parallel_projection = True
        view.parallel_scale = height / 2
        view.clipping_range = (distance / 100, 2 * distance)

    def _draw(self, still: Still) -> None:
        """Add a still's bodies, cells, obstacles and arrows to the window."""
        subject = self._composition.subject
        colouring = self._composition.colouring
        surface = surface_of(subject.surface(still.index), subject.triangles)
        surface["colours"] = colouring.table[colouring.numbers(still.index)]
        surface["fixed"] = subject.fixed(still.index)
        for ground in still.overlays.grounds:
            _draw_ground(self._plotter, ground, surface)
        shading = SHADING | dict(specular=0.08, opacity=0.3 if still.cut else 1.0)
        # clipping PolyData would merge the points along sharp edges
        whole = surface.cast_to_unstructured_grid()
        # a point looks fixed if half of its nodes are
        free, fixed = whole.clip_scalar(scalars="fixed", value=0.5, both=True)
        for part, paint in (free, dict(scalars="colours", rgb=True)), (fixed, dict(color=FIXED)):
            if part.n_cells:
                self._plotter.add_mesh(part, **paint, **shading)
        for kind, cells in (still.cut or {}).items():
            nodes = subject.nodes(still.index)
            grid = pv.UnstructuredGrid({pv.CellType.HEXAHEDRON: cells}, nodes)
            color = KINDS[kind][0]
            self._plotter.add_mesh(grid.shrink(0.86), color=color, ambient=0.5, diffuse=0.55)
        self._draw_obstacles(still.overlays)
        # moved towards the eye, an arrow stays in place and nothing hides it
        towards_eye = 2 * self._depth * self._composition.camera.to_eye
        for tail, tip in still.overlays.arrows:
            _draw_arrow(self._plotter, tail + towards_eye, tip - tail)

    def _draw_obstacles(self, overlays: Overlays) -> None:
        """Add glass, spheres and obstacle meshes to the window."""
        for corners in overlays.glass:
            box = pv.StructuredGrid()
            box.points = corners
            box.dimensions = (2, 2, 2)
            self._plotter.add_mesh(box, color=GLASS, opacity=GLASS_OPACITY, lighting=False)
            self._plotter.add_mesh(
                box.extract_all_edges(), color=GLASS_EDGE, line_width=2, lighting=False
            )
        for ball in overlays.balls:
            sphere = pv.Sphere(
                radius=ball.radius,
                center=ball.center.tolist(),
                theta_resolution=96,
                phi_resolution=96,
            )
            shading: dict[str, Any] = dict(smooth_shading=True, ambient=0.6, diffuse=0.4)
            self._plotter.add_mesh(sphere, color=GLASS, opacity=GLASS_OPACITY, **shading)
        for obstacle in overlays.meshes:
            solid = self._composition.subject.solids[obstacle.number]
            mesh = surface_of(obstacle.moved(solid.points), solid.triangles)
            self._plotter.add_mesh(mesh, color=GLASS, split_sharp_edges=True, **SHADING)


def _draw_ground(plotter: pv.Plotter, ground: Ground, body: pv.PolyData) -> None:
    """Draw a disk that fades towards its rim, and the body's shadow on it."""
    middle = ground.corners.mean(axis=0)
    radius = float(np.linalg.norm(ground.corners[1] - ground.corners[0])) / 2
    normal = ground.normal.tolist()
    disk = pv.Disc(center=middle, inner=0, outer=radius, normal=normal, r_res=20, c_res=RIM_CORNERS)
    share = np.linalg.norm(disk.points - middle, axis=1) / radius
    share = np.clip((1 - share) / (1 - FADING), 0, 1)
    opacity = 255 * share**2 * (3 - 2 * share)
    disk["look"] = np.column_stack(
        [np.tile(pv.Color(GROUND).int_rgb, (disk.n_points, 1)), opacity]
    ).astype(np.uint8)
    plotter.add_mesh(disk, scalars="look", rgb=True, lighting=False)
    shadow = body.copy()
    # above the disk, because coincident surfaces flicker
    lift = 1e-3 * radius
    shadow.points = ground.below(body.points) + lift * ground.normal
    plotter.add_mesh(shadow, color=SHADOW, lighting=False)


def _draw_arrow(plotter: pv.Plotter, tail: Floats, along: Floats) -> None:
    """Draw an arrow from its tail (3,) along a vector (3,)."""
    shape: dict[str, Any] = dict(tip_length=0.36, tip_radius=0.12, shaft_radius=0.045)
    shape |= dict(tip_resolution=40, shaft_resolution=40, scale=float(np.linalg.norm(along)))
    arrow = pv.Arrow(start=tail.tolist(), direction=along.tolist(), **shape)
    plotter.add_mesh(
        arrow, color=ARROW, smooth_shading=True, split_sharp_edges=True, ambient=0.7, diffuse=0.4
    )


@contextmanager
def quiet_opengl() -> Iterator[None]:
    """Keep messages of graphics libraries off the terminal. Raises InputError without OpenGL."""
    terminal = os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        # without screen and EGL, VTK chooses OSMesa, and crashes if OSMesa is missing
        if vtkRenderWindow().IsA("vtkOSOpenGLRenderWindow"):
            raise InputError("no OpenGL to draw with: apt install libegl1 libgl1-mesa-dri")
        yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)
