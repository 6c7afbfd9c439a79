"""`prtbake init`: writes a scene file for a mesh and a material."""

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from formats.errors import MeshError, StorageError
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next, unused
from prt_bake.cli.shared.options import optional_output
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say
from prt_bake.cli.start.materials import complete_material

if TYPE_CHECKING:
    from formats.mesh import Mesh
    from formats.scene.materials import Material
    from prt_bake.cli.start.scene_draft import SceneDraft

_USUAL_SIZE = 100.0
"""Millimetres of the longest side, for meshes whose unit is not known."""

MaterialName = Annotated[
    str | None,
    typer.Option(
        "--material",
        metavar="NAME",
        help="Such as jade; `prtbake materials` lists all.",
        show_default=False,
        autocompletion=complete_material,
    ),
]
ObjectSize = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="LENGTH", help="Longest side of the object: 14cm, 55mm, 0.3m, 6in.", show_default=False
    ),
]
UpAxis = Annotated[
    Literal["y", "z"] | None, typer.Option("--up", help="Axis of the mesh that points up; by default y.")
]


def init(
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="Closed mesh: .glb, .gltf, .obj, .ply or .stl.")],
    material: MaterialName = None,
    size: ObjectSize = None,
    output: Annotated[
        Path | None,
        optional_output("--output -o", "SCENE.toml", "Scene to write; by default NAME.toml, after the mesh.", ".toml"),
    ] = None,
    up: UpAxis = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing scene file.")] = False,
) -> None:
    """Write a commented scene file for a mesh, ready to train.

    Without --size a glTF mesh is in metres, and any other is taken to be 10 cm long.
    """
    from prt_bake.inspection.translucency import remark, translucent_size

    path = output or Path(f"{mesh.stem}.toml")
    mesh.stat()  # a file that is not there is reported first
    refuse_other_kinds({"MESH": (mesh, ("mesh",))})
    check_outputs({"--output": path}, {"MESH": mesh})
    if path.exists() and not force:
        raise StorageError(f"{path}: already exists; add --force to replace it, or choose another name with -o")
    draft = draft_scene(mesh, material, size, path, up)
    write_draft(draft)
    if size is None and draft.light.opaque:
        better = translucent_size(draft.light)
        say(
            f"remark: {draft.material.name} of this size looks opaque, like stone; {better} looks translucent: "
            f"--size {better}"
        )
        others = (*(() if output is None else ("-o", output)), *(() if up is None else ("--up", up)))
        say_next("prtbake", "init", mesh, "--material", material, "--size", better, *others, "--force")
    else:
        if appearance := remark(draft.light, 1.0):
            say(f"remark: {appearance}")
        say_next("prtbake", "make", path, "-o", unused(path.with_suffix("")))


def write_draft(draft: "SceneDraft") -> None:
    """Write the scene of a mesh, and print what was chosen."""
    from formats.atomic import replacing
    from prt_bake.inspection import translucency

    with replacing(draft.path) as part:
        part.write_text(draft.text(), encoding="utf-8")
    if not draft.material.measured:
        say(f"{draft.material.name} is {draft.material.source}")
    paths = draft.light.size / draft.light.transport
    least, most = translucency.digits(paths.min()), translucency.digits(paths.max())
    print(
        f"{draft.path}: {draft.mesh_path.name} in {draft.material.name}, {draft.light.size:.4g} mm long, {least} to "
        f"{most} transport mean free paths (about 5 to 50 look translucent)"
    )


def draft_scene(
    mesh_path: Path, material: str | None, size: str | None, path: Path, up: Literal["y", "z"] | None
) -> "SceneDraft":
    """Return the scene of a mesh, to be written to `path`. Without `up` it is y, which formats of CAD are warned of.

    Raises typer.BadParameter for a material or a size that is not known, MeshError for a faulty mesh.
    """
    substance, length = _material(material), _length(size)
    from formats.mesh import good_normals, read_mesh
    from prt_bake.cli.start.scene_draft import SceneDraft
    from prt_bake.inspection.mesh import find_faults

    if faults := find_faults(mesh_path):
        more = f" (and {len(faults) - 1} more: `prtbake check` lists them)" if len(faults) > 1 else ""
        raise MeshError(f"{faults[0]}{more}")
    mesh = read_mesh(mesh_path)
    unit_in_mm = _unit_in_mm(mesh, mesh_path, length)
    normals: Literal["vertex", "face"] = "vertex" if good_normals(mesh) else "face"
    if up is None and mesh_path.suffix.lower() in (".stl", ".ply"):
        say(f"{mesh_path}: the format names no axis; y is taken to point up; in files of Blender and CAD it is --up z")
    return SceneDraft(path, mesh_path, mesh, substance, unit_in_mm, up or "y", normals)


def _material(name: str | None) -> "Material":
    from formats.scene.materials import find_material

    if name is None:
        raise typer.BadParameter(f"Missing option '--material'. Choose one:\n{_materials_by_group()}")
    try:
        return find_material(name)
    except KeyError as cause:
        raise typer.BadParameter(f"--material: unknown material {name!r}; {cause.args[0]}") from None


def _materials_by_group() -> str:
    from formats.scene.materials import materials

    groups: dict[str, list[str]] = {}
    for material in materials().values():
        groups.setdefault(material.group, []).append(material.name)
    lines = (f"{group}: {', '.join(names)}" for group, names in groups.items())
    return "\n".join(textwrap.fill(line, 80, initial_indent="  ", subsequent_indent="    ") for line in lines)


def _length(size: str | None) -> float | None:
    from formats.scene.units import read_length

    try:
        return None if size is None else read_length(size)
    except ValueError as cause:
        raise typer.BadParameter(f"--size: {cause}") from None


def _unit_in_mm(mesh: "Mesh", path: Path, length: float | None) -> float:
    """Return the millimetres per unit of the mesh, from the length of its longest side if that is given."""
    longest = float((mesh.bounds[1] - mesh.bounds[0]).max())
    if length is not None:
        return length / longest
    if path.suffix.lower() in (".glb", ".gltf"):
        say(f"{path}: glTF is in metres, so the object is {1000.0 * longest:.4g} mm long; --size changes that")
        return 1000.0
    say(f"{path}: the format has no unit of length; the object is taken to be 10 cm long; --size changes that")
    return _USUAL_SIZE / longest
