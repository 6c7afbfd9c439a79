"""`prtbake export`: writes an asset for engines, or a scene for Mitsuba 3."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from formats.errors import QueryError
from prt_bake.cli.shared.ineffective import refuse_ineffective
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next
from prt_bake.cli.shared.options import Force
from prt_bake.cli.shared.outputs import check_outputs
from prt_bake.cli.shared.progress import say

if TYPE_CHECKING:
    from formats.asset import Asset
    from prt_bake.export.extras import StatedLight

Target = Literal["glb", "site", "mitsuba"]
_HIGH_ERROR = 0.05
"""From this error of the coefficients on, the command names the option that lowers it."""


def export(
    context: typer.Context,
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE...", help="Asset, or scene; for a page one or several assets and .glb files."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="OUT", help="X.glb; or a folder: of a page, or of a scene.", show_default=False
        ),
    ],
    to: Annotated[
        Target | None, typer.Option(help="What to write; by default SOURCE and OUT decide.", show_default=False)
    ] = None,
    degree: Annotated[
        int | None,
        typer.Option(min=0, max=8, help="Degree of the harmonics of the view; 3 by default.", show_default=False),
    ] = None,
    error: Annotated[
        float | None,
        typer.Option(
            help="Choose the least degree whose coefficients are within this relative RMSE.", show_default=False
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
            help="Fold this light in, as for `prtbake shade`: a ninth of the size, for this light alone. On a page: a "
            "light to choose, by default the shipped sky. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write an asset for engines or for the web, or a scene for Mitsuba 3.

    An asset becomes X.glb: a glTF file whose vertices carry the transport, in harmonics of the view and of the light.
    For a folder, assets become a page that any web server shows. A scene becomes a folder for Mitsuba 3, lit by a
    constant white environment.
    """
    source = sources[0]
    from prt_bake.inspection.files import kind_of

    kind = kind_of(source)
    is_folder = output.is_dir() or not output.suffix
    if to == "site" or (to is None and kind in ("asset", "mesh") and is_folder):
        refuse_ineffective(
            context, ("sources", "output", "to", "light", "force"), "on a page, which shows assets as they are"
        )
        _to_site(sources, output, light or [], force)
        return
    if len(sources) > 1:
        raise typer.BadParameter(f"{sources[1]}: only a page takes several assets; export one after another")
    refuse_other_kinds({"SOURCE": (source, ("asset", "scene")), "--light": (light, LIGHT)})
    target = to or ("mitsuba" if kind == "scene" else "glb")
    _refuse_other_target(source, kind, target, output)
    if target == "mitsuba":
        _to_mitsuba(source, output)
        return
    check_outputs({"--output": output}, {"SOURCE": source, "--light": light})
    from formats.asset import read_asset
    from prt_bake.export.gltf import prepare_export, write_gltf

    asset = read_asset(source)
    exported = prepare_export(asset, degree, error, quantize, _stated(asset, light or []), folded=bool(light))
    write_gltf(asset, output, exported)
    _print_error(source, output, exported)


def _refuse_other_target(source: Path, kind: str, target: Target, output: Path) -> None:
    if (kind == "scene") != (target == "mitsuba"):
        fitting = "mitsuba" if kind == "scene" else "glb"
        raise QueryError(f"{source}: expected --to {fitting} for {kind} files, found --to {target}")
    if target == "glb" and output.suffix.lower() != ".glb":
        raise QueryError(
            f"{output}: expected a name that ends in .glb, or a folder; give -o {output.with_suffix('.glb')}, or "
            "--to site for a page"
        )


def _to_site(sources: list[Path], folder: Path, lights: list[str], force: bool) -> None:
    assets = [source for source in sources if source.suffix.lower() != ".glb"]
    refuse_other_kinds({"SOURCE": (assets, ("asset",)), "--light": (lights, LIGHT)})
    from prt_bake.export.site import export_site

    size = export_site(sources, folder, lights, force=force, say=say)
    print(f"{folder}: a page of {size / 1e6:.1f} MB, for any web server")
    say_next("python3", "-m", "http.server", "--directory", folder)


def _to_mitsuba(scene: Path, folder: Path) -> None:
    from formats.scene import read_scene
    from prt_bake.export.mitsuba_xml import exported_files, write_mitsuba_scene

    read = read_scene(scene)
    check_outputs({"--output": exported_files(read, folder)}, {"SOURCE": scene}, folder=folder)
    written = write_mitsuba_scene(read, folder)
    print(f"wrote {written}")
    if shutil.which("mitsuba"):
        say_next("mitsuba", written)


def _stated(asset: "Asset", lights: list[str]) -> "StatedLight | None":
    """The sum of the lights, in harmonics; None without lights."""
    if not lights:
        return None
    from prt_bake.export.extras import StatedLight
    from prt_bake.lights.lighting import read_lighting
    from prt_bake.shading.sun_shading import suns_apart

    lighting = read_lighting(lights, asset.up, say=say, mesh=asset.mesh, degree=asset.degree)
    names = [Path(light).name for light in lights]
    return StatedLight(" + ".join(names), suns_apart(lighting, asset.degree, "plain").harmonics, 1.0)


def _print_error(source: Path, output: Path, exported: Any) -> None:
    error, degree = exported.error, exported.form.view_degree
    print(f"{output}: {output.stat().st_size:,} bytes, harmonics of the view of degree {degree}")
    print(
        f"error compared with {source.name}: coefficients {error.coefficients:.2%} (95 % of vertices within "
        f"{error.coefficients_95:.2%}); radiance of vertices {error.radiance_median:.2%}, at worst "
        f"{error.radiance_worst:.2%}"
    )
    print(f"error of {source.name} itself: {exported.extras['asset_error']}")
    print(f"not in the file: {', '.join(exported.extras['left_out'])}")
    if error.coefficients > _HIGH_ERROR:
        say(f"{output}: --error {_HIGH_ERROR:g} chooses the degree for an error of {_HIGH_ERROR:.0%}")
