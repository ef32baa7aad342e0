"""The schema of a scene file: frozen, validated tables. What a key means and its unit stand in its description."""

from collections.abc import Iterator
from itertools import chain
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from msmpetsc.scene.bodies import OF_REGIONS, BodyTable, OfBody, regions_of_no_body, unlike_the_material
from msmpetsc.scene.body import CagesTable, Material, MeshTable, PartTable
from msmpetsc.scene.motion import AnchorTable, Force, Gravity, Pin, Start
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable, SelfContactTable
from msmpetsc.scene.problems import Broken, KeyPath, rule
from msmpetsc.scene.time import Time, one_state, unlike_the_integrator
from msmpetsc.scene.values import Count, Direction, FileName, ListOf, NotNegative, PresetName, Table, Vector


class Solver(Table):
    """Solver of a step."""

    preset: PresetName = Field("newton", min_length=1, description="named set of PETSc options")
    error: float | None = Field(None, gt=0, lt=1, description="relative error of a step to aim at [-]")
    max_iterations: Count | None = Field(None, description="outer iterations allowed in a step [-]")


class Safety(Table):
    """Checks of a run, and recovery of steps that fail."""

    on_failure: Literal["stop", "substep", "fallback"] = Field(
        "stop", description="stop the run; take that step in shorter ones; or solve it with a slower, robust method"
    )
    checks: bool = Field(True, description="balance the energy of every step, and count cells inside out")


class Probe(Table):
    """A point of the body that is followed."""

    name: FileName = Field(description="of its columns in `msmpetsc series`")
    point: Vector = Field(description="where it is at rest; it goes with the cell that it lies in [m]")


class Output(Table):
    """Choice of what the result file stores beside the lattice."""

    surface: bool = Field(True, description="store the surface of every frame")
    stress: bool = Field(
        False, description='store stress and strain energy of every frame; with material.law = "neo-hookean"'
    )
    probe: ListOf[Probe] = Field((), description="points of the body whose places are stored")
    every: Count = Field(1, description="store every N-th step only, and the last [-]")

    @field_validator("probe")
    @classmethod
    def _has_distinct_names(cls, probes: tuple[Probe, ...]) -> tuple[Probe, ...]:
        if len({probe.name for probe in probes}) < len(probes):
            raise rule("must have a name of its own for each")
        return probes


class Picture(Table):
    """View of the result in pictures."""

    eye: Direction | None = Field(
        None, description="direction from the body to the eye, of any length; across its longer side if absent [-]"
    )
    times: ListOf[NotNegative] = Field(
        (), description="moments drawn beside the start [s]; chosen by their energies if absent"
    )


class SceneFile(Table):
    """What may stand in a scene file; ``SceneFile.model_json_schema()`` is its schema."""

    one_of = ("mesh", "body")
    title: str = Field("", description="for the reader")
    mesh: MeshTable | None = Field(None, description="the closed surface of the one body")
    cages: CagesTable = Field(description="the cells that fill it")
    material: Material = Field(description="what it is made of")
    time: Time = Field(description="time step and duration")
    body: ListOf[BodyTable] = Field((), min_length=1, description="each of several bodies, in place of mesh")
    part: ListOf[PartTable] = Field((), description="cells of another material")
    start: Start | None = Field(None, description="how it is at time 0; at rest in its rest shape if absent")
    gravity: Gravity | None = Field(None, description="a uniform field; none if absent")
    obstacle: ListOf[ObstacleTable] = Field((), description="what nodes bounce off")
    self_contact: SelfContactTable | None = Field(None, description="what keeps the surface from crossing itself")
    pin: ListOf[Pin] = Field((), description="nodes that stay where they are")
    anchor: ListOf[AnchorTable] = Field((), description="nodes led along a path")
    force: ListOf[Force] = Field((), description="forces on parts of the body")
    solver: Solver = Field(default_factory=lambda: Solver.model_validate({}), description="how a step is solved")
    safety: Safety = Field(
        default_factory=lambda: Safety.model_validate({}), description="what is done about a failed step"
    )
    output: Output = Field(default_factory=lambda: Output.model_validate({}), description="what is stored")
    picture: Picture = Field(default_factory=lambda: Picture.model_validate({}), description="how the result is drawn")

    @model_validator(mode="before")
    @classmethod
    def _of_one_state(cls, data: Any) -> Any:
        return one_state(data)

    def broken_rules(self) -> Iterator[Broken]:
        """Yield the rules that the tables break among each other."""
        if self.output.stress and self.material.poisson is None:
            words = f'may not have stress = true with material.law = "{self.material.law}": springs have no stress'
            yield "output", rule(words, "material")
        yield from chain(unlike_the_material(self), regions_of_no_body(self), unlike_the_integrator(self))

    @property
    def stored(self) -> int:
        """Return the number of frames, frame 0 included."""
        return self.stored_until(self.time.steps)

    def stored_until(self, step: int) -> int:
        """Return the number of frames of the first steps: of every ``every``-th and of the last."""
        every = self.output.every
        return 1 + (-(-step // every) if step == self.time.steps else step // every)

    @property
    def meshes(self) -> dict[KeyPath, MeshTable]:
        """Return the surface of each body, by the path of its key."""
        if self.mesh is not None:
            return {("mesh",): self.mesh}
        return {("body", number, "mesh"): body.mesh for number, body in enumerate(self.body)}

    @property
    def touching(self) -> SelfContactTable | None:
        """How surfaces touch: those of the bodies, or where these may cross, theirs and obstacles'; None if none do."""
        meets = any(obstacle.response == BARRIER for obstacle in self.obstacle)
        return self.self_contact or (SelfContactTable.model_validate({}) if meets else None)

    @property
    def starts(self) -> list[Start | None]:
        """Return the starts of all bodies at time 0."""
        return [body.start or self.start for body in self.body] or [self.start]

    def tables(self, kind: str) -> Iterator[OfBody]:
        """Yield the tables of a kind: the scene's own, which are of all bodies, then those of each body."""
        for number, table in enumerate(getattr(self, kind)):
            yield OfBody((kind, number), None, table)
        for body, tables in enumerate(self.body):
            for number, table in enumerate(getattr(tables, kind)):
                yield OfBody(("body", body, kind, number), body, table)

    def named_files(self) -> Iterator[tuple[KeyPath, str]]:
        """Yield key path and name of each file that it names; a mesh's name may be one of the registry's too."""
        solids = {("obstacle", number, "mesh"): o.mesh for number, o in enumerate(self.obstacle) if o.mesh is not None}
        for path, mesh in (self.meshes | solids).items():
            yield (*path, "source"), mesh.source
        for path, _, table in chain.from_iterable(self.tables(kind) for kind in OF_REGIONS):
            if isinstance(table.region.painted, str):
                yield (*path, "region", "painted"), table.region.painted
