"""The schema of a scene file: its TOML tables, their keys and ranges."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationInfo, field_validator, model_validator

from formats.scene.solid_texture import Pattern
from formats.scene.units import MILLIMETRES, NO_UNIT, unit_symbol

_Unit = Annotated[float, Field(ge=0, le=1)]
_Extinction = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(ge=-1e30, le=1e30)]
_Point = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Strict(False)]
_Density = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Extinctions = Annotated[tuple[_Extinction, _Extinction, _Extinction], Strict(False)]
_Colour = Annotated[tuple[_Unit, _Unit, _Unit], Strict(False)]


class Table(BaseModel):
    """A table without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class ObjectTable(Table):
    """[object]: the outer surface, a mesh file relative to the folder of the scene file."""

    mesh: str = Field(min_length=1)
    up: Literal["y", "z"] = "y"
    unit_in_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    unit: str = NO_UNIT

    @field_validator("unit")
    @classmethod
    def _known_unit(cls, value: str, info: ValidationInfo) -> str:
        """Return the symbol of a known unit; another name needs `unit_in_mm`."""
        given = info.data.get("unit_in_mm")
        try:
            symbol = unit_symbol(value)
        except ValueError as cause:
            if value == NO_UNIT or given is not None:
                return value
            raise ValueError(
                f"{value!r} is not a known unit of length; {cause}; or add its length, such as unit_in_mm = 10.0"
            ) from None
        if given not in (None, MILLIMETRES[symbol]):
            length = f"{MILLIMETRES[symbol]:g} millimetres"
            raise ValueError(f"{value!r} has {length}, but unit_in_mm is {given:g}; remove one of them")
        return symbol

    @property
    def stated_unit(self) -> str:
        """The unit as models and assets state it: its symbol, or its length, such as "81.49442 mm"."""
        other = self.unit_in_mm is not None and self.unit not in MILLIMETRES
        return f"{self.unit_in_mm:.7g} mm" if other else self.unit

    @property
    def length_in_mm(self) -> float | None:
        """Millimetres per scene unit; None if they are not known."""
        return MILLIMETRES.get(self.unit) if self.unit_in_mm is None else self.unit_in_mm


class InterfaceTable(Table):
    """[interface]: the dielectric boundary, index-matched by default. A string names a roughness texture."""

    eta: float | None = Field(default=None, ge=0.25, le=4)
    roughness: _Unit | str = 0.0
    normals: Literal["face", "vertex"] = "face"
    energy_compensation: bool = False


class MixTable(Table):
    """[medium.mix]: a second substance, blended in by a procedural pattern."""

    material: str | None = None
    density: _Density = 1.0
    sigma_t: _Extinction | _Extinctions | None = None
    albedo: _Unit | _Colour | None = None
    pattern: Pattern
    feature: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    seed: int = Field(default=0, ge=0, lt=2**63)
    octaves: int = Field(default=4, ge=1, le=10)
    thresholds: Annotated[tuple[_Coordinate, _Coordinate], Strict(False)] | None = None
    resolution: int = Field(default=64, ge=2, le=256)

    @field_validator("thresholds")
    @classmethod
    def _ascending_thresholds(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not value[0] < value[1]:
            raise ValueError("the first threshold must be below the second")
        return value


class MediumTable(Table):
    """[medium]: either `material`, or `sigma_t` and `albedo`; a string names a grid file."""

    material: str | None = None
    density: _Density = 1.0
    sigma_t: _Extinction | _Extinctions | str | None = None
    albedo: _Unit | _Colour | str | None = None
    phase_g: float = Field(default=0.0, gt=-1, lt=1)
    bounds: Annotated[tuple[_Point, _Point], Strict(False)] | None = None
    mix: MixTable | None = None

    @field_validator("bounds")
    @classmethod
    def _ascending_corners(cls, value: tuple[_Point, _Point] | None) -> tuple[_Point, _Point] | None:
        if value is not None and not all(low < high for low, high in zip(*value, strict=True)):
            raise ValueError("the lowest corner must come first and be below the highest in x, y and z")
        return value


class InsideTable(Table):
    """[[inside]]: an object inside the part named by `in`; diffuse, or a dielectric with a medium."""

    name: str = Field(min_length=1)
    mesh: str = Field(min_length=1)
    inside_of: str | None = Field(default=None, alias="in")
    surface: Literal["diffuse"] | None = None
    reflectance: _Unit | _Colour | str | None = None
    interface: InterfaceTable | None = None
    medium: MediumTable | None = None

    @model_validator(mode="after")
    def _one_surface(self) -> "InsideTable":
        if self.surface is None and self.reflectance is not None:
            raise ValueError('reflectance needs surface = "diffuse"; a dielectric has [inside.interface]')
        if self.surface == "diffuse" and self.reflectance is None:
            raise ValueError("reflectance is missing; a diffuse surface needs it")
        if self.surface == "diffuse" and (self.interface is not None or self.medium is not None):
            table = "interface" if self.interface is not None else "medium"
            raise ValueError(f'a diffuse surface lets no light in; remove [inside.{table}], or surface = "diffuse"')
        return self


class SceneFile(Table):
    """A complete scene file."""

    object: ObjectTable
    interface: InterfaceTable = InterfaceTable()
    medium: MediumTable
    inside: Annotated[tuple[InsideTable, ...], Strict(False)] = ()
