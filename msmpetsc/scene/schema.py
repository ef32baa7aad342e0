"""The schema of a scene file: frozen, validated tables with meaning and unit of each key."""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from msmpetsc.scene.body import CagesTable, Material, MeshTable, OwnMaterial, PartTable
from msmpetsc.scene.motion import AnchorTable, Force, Gravity, Pin, Pressure, Start, Traction
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable, SelfContactTable
from msmpetsc.scene.problems import Broken, KeyPath, rule
from msmpetsc.scene.time import Time, one_state, unlike_the_integrator
from msmpetsc.scene.values import (
    Count,
    FileName,
    GroupName,
    ListOf,
    NotNegative,
    PresetName,
    Table,
    UnitVector,
    Vector,
)

# largest ratio of stiffnesses or densities in a scene [-]; so that CG converges
MAX_CONTRAST = 1e6
# tables that hold nodes: a node in several tables belongs to the first
HOLDERS = ("pin", "anchor")
SURFACE_LOADS = ("traction", "pressure")
# tables with a region; a body or the whole scene may have them
OF_REGIONS = ("part", *HOLDERS, "force", *SURFACE_LOADS)


class BodyTable(Table):
    """A body of a scene with several bodies. Regions in its tables select from this body only."""

    mesh: MeshTable = Field(description="closed surface of the body")
    material: OwnMaterial | None = Field(
        None, description="material of the body; the scene's material if absent"
    )
    part: ListOf[PartTable] = Field((), description="cells of another material")
    start: Start | None = Field(
        None, description="state of the body at time 0; the scene's start if absent"
    )
    pin: ListOf[Pin] = Field((), description="nodes that stay at their rest positions")
    anchor: ListOf[AnchorTable] = Field((), description="nodes that move along a prescribed path")
    force: ListOf[Force] = Field((), description="forces on parts of the body")
    traction: ListOf[Traction] = Field((), description="dead loads on parts of the surface")
    pressure: ListOf[Pressure] = Field((), description="pressures on closed surfaces")


class OfBody(NamedTuple):
    """A table with a region, and the body that the region selects from.

    path : key path of the table in the scene
    body : number of the body; None for all bodies
    """

    path: KeyPath
    body: int | None
    table: Any

    @property
    def key(self) -> str:
        """Return the key path as a string, for example "body.1.pin.0"."""
        return ".".join(map(str, self.path))


def unlike_the_material(scene: Any) -> Iterator[Broken]:
    """Yield the broken rules between the scene's material and the materials of bodies and parts.

    All materials must give the same key, Young's modulus or stiffness.
    """
    materials: dict[str, OwnMaterial] = {part.key: part.table for part in scene.tables("part")}
    materials |= {
        f"body.{number}.material": body.material
        for number, body in enumerate(scene.body)
        if body.material
    }
    for key, material in materials.items():
        table = key.partition(".")[0]
        for name in Material.one_of:
            if getattr(material, name) is not None and getattr(scene.material, name) is None:
                words = f"may give {name} only where material does, as {key} does"
                yield table, rule(words)
        if material.poisson_ratio is not None and scene.material.poisson is None:
            words = f'may give poisson_ratio only with material.law = "neo-hookean", as {key} does'
            yield table, rule(words)
    for name in (*Material.one_of, "density"):
        values = {
            key: value
            for key, material in materials.items()
            if (value := getattr(material, name)) is not None
        }
        given = [*values.values(), *filter(None, [getattr(scene.material, name)])]
        if values and max(given) > MAX_CONTRAST * min(given):
            words = (
                f"has {name} of {min(given):g} to {max(given):g} in one run: a ratio above "
                f"{MAX_CONTRAST:g}, which is as good as rigid, is not solved; pin or anchor the "
                "stiff part"
            )
            yield next(reversed(values)).partition(".")[0], rule(words)


def regions_of_no_body(scene: Any) -> Iterator[Broken]:
    """Yield a broken rule for each relative or painted region outside the tables of a body.

    The rule holds in scenes with several bodies.
    """
    for kind in OF_REGIONS:
        for number, table in enumerate(getattr(scene, kind) if scene.body else ()):
            if table.region.relative or table.region.painted is not None:
                sort = "relative" if table.region.relative else "painted"
                words = (
                    f"may have no {sort} region beside [[body]], as {kind}.{number} has: move it "
                    f"into [[body.{kind}]], which names the body"
                )
                yield kind, rule(words)


# relative error of a step if neither scene nor preset gives another [-]
DEFAULT_STEP_ERROR = 1e-3


class Solver(Table):
    """Solver of a time step."""

    preset: PresetName = Field("newton", min_length=1, description="named set of PETSc options")
    error: float | None = Field(
        None, gt=0, lt=1, description="target relative error of a step; the preset's if absent [-]"
    )
    max_iterations: Count | None = Field(
        None, description="largest number of outer iterations in a step [-]"
    )


class Safety(Table):
    """Recovery of steps that fail."""

    on_failure: Literal["stop", "substep", "fallback"] = Field(
        "stop",
        description="stop the run; divide the step into shorter steps; or solve the step with a "
        "slower, robust method",
    )


class Probe(Table):
    """A material point whose position is stored in each frame."""

    one_of = ("point", "group")
    name: FileName = Field(description="name of the probe's columns in `msmpetsc series`")
    point: Vector | None = Field(
        None, description="rest position; the probe follows the cell that contains it [m]"
    )
    group: GroupName | None = Field(
        None,
        description="group of triangles in the mesh file: the probe is their point nearest to "
        "their centre [-]",
    )


class Output(Table):
    """The optional content of the result file."""

    surface: bool = Field(True, description="store the surface of every frame")
    stress: bool = Field(
        False,
        description="store stress and strain energy of every frame, "
        'with material.law = "neo-hookean"',
    )
    probe: ListOf[Probe] = Field((), description="points of the body whose positions are stored")
    every: Count = Field(1, description="store every N-th step and the last step [-]")

    @field_validator("probe")
    @classmethod
    def _has_distinct_names(cls, probes: tuple[Probe, ...]) -> tuple[Probe, ...]:
        if len({probe.name for probe in probes}) < len(probes):
            raise rule("must give each probe a different name")
        return probes


class Picture(Table):
    """View of the result in pictures."""

    eye: UnitVector | None = Field(
        None,
        description="direction from the body to the eye, of any nonzero length; across the body's "
        "longer side if absent [-]",
    )
    times: ListOf[NotNegative] = Field(
        (), description="times drawn besides the start [s]; chosen from the energies if absent"
    )


def table_of_defaults(table: type[Table], description: str) -> Any:
    """Return the field of a table that takes its default values if it is absent."""
    return Field(default_factory=lambda: table.model_validate({}), description=description)


class SceneFile(Table):
    """The tables of a scene file; ``SceneFile.model_json_schema()`` is its JSON schema."""

    one_of = ("mesh", "body")
    title: str = Field("", description="title for the reader")
    mesh: MeshTable | None = Field(None, description="closed surface of the only body")
    cages: CagesTable = Field(description="cells that fill the body")
    material: Material = Field(description="material of the body")
    time: Time = Field(description="time step, duration and integrator")
    body: ListOf[BodyTable] = Field(
        (), min_length=1, description="tables of several bodies, in place of mesh"
    )
    part: ListOf[PartTable] = Field((), description="cells of another material")
    start: Start | None = Field(
        None, description="state at time 0; at rest in the rest shape if absent"
    )
    gravity: Gravity | None = Field(None, description="uniform gravity; none if absent")
    obstacle: ListOf[ObstacleTable] = Field((), description="solids that bodies bounce off")
    self_contact: SelfContactTable | None = Field(
        None, description="contact of surfaces with themselves and each other; none if absent"
    )
    pin: ListOf[Pin] = Field((), description="nodes that stay at their rest positions")
    anchor: ListOf[AnchorTable] = Field((), description="nodes that move along a prescribed path")
    force: ListOf[Force] = Field((), description="forces on parts of the body")
    traction: ListOf[Traction] = Field((), description="dead loads on parts of the surface")
    pressure: ListOf[Pressure] = Field((), description="pressures on closed surfaces")
    solver: Solver = table_of_defaults(Solver, "solver of a time step")
    safety: Safety = table_of_defaults(Safety, "recovery of steps that fail")
    output: Output = table_of_defaults(Output, "optional content of the result file")
    picture: Picture = table_of_defaults(Picture, "view of the result in pictures")

    @model_validator(mode="before")
    @classmethod
    def _of_one_state(cls, data: Any) -> Any:
        return one_state(data)

    def broken_rules(self) -> Iterator[Broken]:
        """Yield the broken rules between different tables."""
        if self.output.stress and self.material.poisson is None:
            words = (
                f'may not have stress = true with material.law = "{self.material.law}": '
                "springs have no stress"
            )
            yield "output", rule(words)
        yield from chain(
            unlike_the_material(self), regions_of_no_body(self), unlike_the_integrator(self)
        )

    @property
    def stored(self) -> int:
        """Return the number of stored frames, frame 0 included."""
        return self.stored_until(self.time.steps)

    def stored_until(self, step: int) -> int:
        """Return the number of frames stored up to a step, frame 0 included."""
        every = self.output.every
        return 1 + (-(-step // every) if step == self.time.steps else step // every)

    @property
    def meshes(self) -> dict[KeyPath, MeshTable]:
        """Return the mesh table of each body by its key path."""
        if self.mesh is not None:
            return {("mesh",): self.mesh}
        return {("body", number, "mesh"): body.mesh for number, body in enumerate(self.body)}

    @property
    def touching(self) -> SelfContactTable | None:
        """Return the settings of surface contact; None without self-contact and barriers.

        Barriers without [self_contact] use its defaults.
        """
        has_barrier = any(obstacle.response == BARRIER for obstacle in self.obstacle)
        return self.self_contact or (SelfContactTable.model_validate({}) if has_barrier else None)

    @property
    def starts(self) -> list[Start | None]:
        """Return the start table of each body, None for a body at rest."""
        return [body.start or self.start for body in self.body] or [self.start]

    def tables(self, *kinds: str) -> Iterator[OfBody]:
        """Yield the tables of each kind: first the scene's own, then the tables of each body."""
        for kind in kinds:
            for number, table in enumerate(getattr(self, kind)):
                yield OfBody((kind, number), None, table)
            for body, tables in enumerate(self.body):
                for number, table in enumerate(getattr(tables, kind)):
                    yield OfBody(("body", body, kind, number), body, table)

    def leaves(self) -> Iterator[tuple[KeyPath, Any]]:
        """Yield key path and value of each key whose value is no table."""
        yield from _leaves((), self.model_dump(exclude_none=True, by_alias=True))

    def named_files(self, changes: Iterable[str] = ()) -> Iterator[tuple[str, str]]:
        """Yield key and name of each file that no ``--set`` of ``changes`` gives."""
        changed = tuple(f"{change.partition('=')[0].strip()}." for change in changes)
        for path, value in self.leaves():
            key = ".".join(map(str, path))
            is_file = path[-1] in ("source", "from", "painted") and isinstance(value, str)
            if is_file and not f"{key}.".startswith(changed):
                yield key, value


def _leaves(path: KeyPath, value: Any) -> Iterator[tuple[KeyPath, Any]]:
    """Yield key path and value of each leaf of nested tables."""
    if isinstance(value, (list, tuple)) and any(isinstance(item, dict) for item in value):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield path, value
        return
    for key, inner in value.items():
        yield from _leaves((*path, key), inner)
