"""`prtbake export`: writes an asset for engines and browsers, or a scene for Mitsuba 3."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.errors import QueryError, StorageError
from prt_bake.cli.shared.ineffective import refuse_ineffective
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next
from prt_bake.cli.shared.options import Mend, within
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say

if TYPE_CHECKING:
    from formats.asset import Asset
    from prt_bake.export.extras import StatedLight

Target = Literal["glb", "exr", "site", "mitsuba"]
_SUFFIXES: dict[str, Target] = {".glb": "glb", ".exr": "exr"}
_FITTING: dict[Target, tuple[str, ...]] = {
    "glb": ("asset",),
    "exr": ("asset",),
    "site": ("asset", "mesh"),
    "mitsuba": ("scene",),
}
"""The kinds of files that can become each target; a mesh here is the .glb of an asset."""
_ALWAYS = ("source", "output", "to")
_EFFECTIVE: dict[Target, tuple[str, ...]] = {
    "glb": (*_ALWAYS, "degree", "error", "quantize", "light", "mend", "onto"),
    "exr": (*_ALWAYS, "degree", "error", "light", "mend"),
    "site": (*_ALWAYS, "light", "mend", "force"),
    "mitsuba": _ALWAYS,
}
"""The options that each target takes."""
_HIGH_ERROR = 0.05
"""From this error of the coefficients on, the command names the option that lowers it."""


def export(
    context: typer.Context,
    source: Annotated[
        list[Path], typer.Argument(metavar="SOURCE", help="Asset; several for a site; or a scene for Mitsuba.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="OUT", help="X.glb, X.exr, or a folder: a site, for a scene that of Mitsuba."
        ),
    ],
    to: Annotated[
        Target | None, typer.Option(help="What to write; by default OUT and SOURCE decide.", show_default=False)
    ] = None,
    degree: Annotated[
        int | None,
        typer.Option(min=0, max=8, help="Degree of the harmonics of the view; 3 by default.", show_default=False),
    ] = None,
    error: Annotated[
        float | None,
        typer.Option(
            callback=within(0.0, 1.0),
            help="Choose the least degree whose coefficients are within this relative RMSE.",
            show_default=False,
        ),
    ] = None,
    quantize: Annotated[
        Literal["int8"] | None,
        typer.Option(help="Store 8 bits for each number: a third of the size; not for Blender.", show_default=False),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="LIGHT",
            help="As for `prtbake shade`. A file: fold this light in, a ninth of the size, for this light alone. A "
            "site: a light of the page; can be repeated.",
            show_default=False,
        ),
    ] = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            metavar="USER.glb",
            help="The glTF file that was baked: OUT is this file with its materials and nodes, and the attributes.",
            show_default=False,
        ),
    ] = None,
    mend: Mend = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the folder of a site.")] = False,
) -> None:
    """Write an asset for engines and browsers, or a scene for Mitsuba 3.

    X.glb is a glTF file whose vertices carry the transport, in harmonics of the view and of the light. X.exr is the
    same as a texture, with X.json and X.mesh.glb. A site is a folder with a page that shows the asset, for any web
    server. A scene becomes a folder for Mitsuba 3, lit by a constant white environment.
    """
    others = [each for each in source if each.suffix.lower() != ".glb"]
    refuse_other_kinds({"SOURCE": (others, ("asset", "scene")), "--light": (light, LIGHT), "--onto": (onto, ("mesh",))})
    target = _target(source, output, to)
    refuse_ineffective(context, _EFFECTIVE[target], f"on --to {target}")
    if target == "mitsuba":
        _to_mitsuba(source[0], output)
    elif target == "site":
        _to_site(source, output, light or [], mend, force)
    else:
        from prt_bake.export.exr import texture_files, write_textures

        outputs = texture_files(output) if target == "exr" else (output,)
        check_outputs({"--output": outputs}, {"SOURCE": source, "--light": light, "--onto": onto})
        _refuse_foreign(outputs)
        from formats.asset import read_asset
        from prt_bake.export.gltf import prepare_export, write_gltf

        asset = read_asset(source[0])
        stated = _stated(asset, light or [], mend)
        exported = prepare_export(asset, degree, error, quantize, stated, halves=target == "exr")
        if target == "exr":
            write_textures(asset, output, exported)
        else:
            write_gltf(asset, output, exported, onto)
        _print_error(source[0], output, exported)
        if len(outputs) > 1:
            print(f"beside it: {', '.join(path.name for path in outputs[1:])}")


def _target(source: list[Path], output: Path, to: Target | None) -> Target:
    """What to write; raises QueryError for sources that cannot become it."""
    from prt_bake.inspection.files import kind_of

    kinds = [kind_of(each) for each in source]
    if to is None and output.suffix.lower() not in ("", *_SUFFIXES) and not output.is_dir():
        raise QueryError(f"{output}: expected a name that ends in .glb or .exr, or a folder (--to site if this is one)")
    target = to or _SUFFIXES.get(output.suffix.lower()) or ("mitsuba" if kinds[0] == "scene" else "site")
    for each, kind in zip(source, kinds, strict=True):
        if kind not in _FITTING[target]:
            fitting = " or ".join(name for name, possible in _FITTING.items() if kind in possible)
            raise QueryError(f"{each}: --to {target} does not take this kind of file, {kind}; expected --to {fitting}")
    if target != "site" and len(source) > 1:
        raise QueryError(f"{output}: is made of one SOURCE, found {len(source)}; only a site shows several")
    if target in _SUFFIXES.values() and _SUFFIXES.get(output.suffix.lower()) != target:
        named = output.with_suffix(f".{target}")
        raise QueryError(f"{output}: expected a name that ends in .{target}; give -o {named}")
    return target


def _refuse_foreign(outputs: tuple[Path, ...]) -> None:
    """Refuse to replace files that no export wrote: a modelled mesh or a texture may have the name of the asset."""
    from prt_bake.inspection.exported import is_exported

    exported = is_exported(outputs[1] if len(outputs) > 1 else outputs[0])
    for path in outputs:
        if path.exists() and not exported:
            raise StorageError(
                f"{path}: already exists, and is no export of prtbake; choose another name, or remove it"
            )


def _to_site(assets: list[Path], folder: Path, lights: list[str], mend: bool, force: bool) -> None:
    from prt_bake.export.site import export_site

    size = export_site(assets, folder, lights, force=force, mend=mend, say=say)
    print(f"{folder}: {size / 1e6:.1f} MB, a page that any web server shows")
    say_next("python3", "-m", "http.server", "--bind", "127.0.0.1", "--directory", folder)


def _to_mitsuba(scene: Path, folder: Path) -> None:
    from formats.scene import read_scene
    from prt_bake.export.mitsuba_xml import exported_files, write_mitsuba_scene

    read = read_scene(scene)
    check_outputs({"--output": exported_files(read, folder)}, {"SOURCE": scene}, folder=folder)
    written = write_mitsuba_scene(read, folder)
    print(f"wrote {written}")
    if shutil.which("mitsuba"):
        say_next("mitsuba", written)


def _stated(asset: "Asset", lights: list[str], mend: bool) -> "StatedLight | None":
    """The sum of the lights, in harmonics; None without lights."""
    if not lights:
        return None
    from prt_bake.export.extras import StatedLight
    from prt_bake.lights.lighting import read_lighting
    from prt_bake.shading.sun_shading import suns_apart

    lighting = read_lighting(lights, asset.up, mend=mend, say=say, mesh=asset.mesh, degree=asset.degree)
    names = [Path(light).name for light in lights]
    return StatedLight(" + ".join(names), suns_apart(lighting, asset.degree, "plain").harmonics)


def _print_error(source: Path, output: Path, exported: Any) -> None:
    from prt_bake.export.engine_form import HIGHEST_DEGREE

    error, degree = exported.error, exported.form.view_degree
    print(f"{output}: {output.stat().st_size:,} bytes, harmonics of the view of degree {degree}")
    print(
        f"error compared with {source.name}: coefficients {error.coefficients:.2%} (95 % of vertices within "
        f"{error.coefficients_95:.2%}); radiance of vertices {error.radiance_median:.2%}, at worst "
        f"{error.radiance_worst:.2%}"
    )
    print(f"error of {source.name} itself: {exported.extras['asset_error']}")
    print(f"not in the file: {', '.join(exported.extras['left_out'])}")
    if error.coefficients > _HIGH_ERROR and degree < HIGHEST_DEGREE:
        say(f"{output}: a higher --degree, up to {HIGHEST_DEGREE}, lowers the error of the coefficients")
