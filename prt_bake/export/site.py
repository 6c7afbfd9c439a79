"""The page that shows assets in a browser: a folder of files that any web server hands out as they are.

`page/` holds its HTML, JavaScript and styles. `page/vendor/` holds three.js and h5wasm, which `make site` copies from
npm packages; it is in the wheel and not in the repository. The page reads `site.json`: `objects` and `lights`, each
with a name and a file, the first of each first.
"""

import json
import math
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from formats.asset import read_asset
from formats.asset.compact_record import CompactCoefficients
from formats.atomic import create_folder, existing, storage_error
from formats.errors import FormatError, QueryError, StorageError
from formats.image import write_image
from formats.json_report import as_text
from formats.mesh import Mesh
from formats.version import program_version
from prt_bake.export.light_pictures import light_picture
from prt_bake.inspection.exported import glb_extras
from prt_bake.lights.lighting import Lighting, read_lighting
from prt_bake.shipped.examples import example

PAGE = Path(__file__).parent / "page"
_SUFFIXES = (".html", ".js", ".css")
_OF_SYSTEMS = {".DS_Store", "Thumbs.db", "desktop.ini"}
"""What file managers leave in a folder that somebody looked into."""
_MOST_TEXELS = 8192**2
"""Of a texture on a GPU of a browser (`page/shader.js`)."""
_LARGE = 50e6
"""Bytes of an asset above which a smaller form is recommended."""

Content = Path | bytes
"""A file that is copied, or its content."""
Paths = str | Path | Sequence[str | Path]
"""One or several."""


@dataclass(frozen=True)
class _Shown:
    """What the page needs to know of an object: its axis, its mesh for lights near it, and what is not shown."""

    up: str
    mesh: Mesh | None
    takes_light: bool
    remarks: tuple[str, ...]


def export_site(
    assets: Paths,
    folder: str | Path,
    lights: Paths = (),
    *,
    force: bool = False,
    mend: bool = False,
    say: Callable[[str], None] = print,
) -> int:
    """Write a folder that any web server shows: the page, the assets and the lights; return its size in bytes.

    The folder appears when it is complete. Without a light it is the shipped sky.

    Args:
        assets: one or several: `.h5`, plain or compact, and `.glb` files of `prtbake export`; copied as they are.
        folder: the folder to write.
        lights: one or several of what `prt.read_lighting` takes; each becomes a lat-long `.hdr`.
        force: replaces a folder that an earlier export wrote.
        mend: repairs bad pixels of skies.
        say: called with what the page does not show.

    Raises:
        StorageError: the packages of the page are missing, a file is missing, the folder exists or cannot be written.
        PrtbakeError: an asset or a light cannot be read.
    """
    target = Path(folder)
    _refuse_other_folder(target, force)
    target = target.resolve()  # a link stays, and its folder is written
    files = site_files(assets, lights, mend=mend, say=say)
    for asset in map(Path, _several(assets)):
        if asset.suffix.lower() != ".glb" and asset.stat().st_size > _LARGE:
            say(
                f"{asset}: every visitor of the page loads its {asset.stat().st_size / 1e6:.0f} MB; a smaller one: "
                f"prtbake compress {asset} -o {asset.with_suffix('.compact.h5')}"
            )
    create_folder(target.parent)
    try:
        _write(target, files)
    except OSError as cause:
        if isinstance(cause, StorageError):
            raise
        raise storage_error(folder, cause) from cause
    return sum(path.stat().st_size for path in target.rglob("*") if path.is_file())


def site_files(
    assets: Paths,
    lights: Paths = (),
    *,
    mend: bool = False,
    say: Callable[[str], None] = print,
) -> dict[str, Content]:
    """Return the files of the page by their names, with / between folders; arguments and errors of `export_site`."""
    paths = [existing(asset) for asset in _several(assets)]
    if not paths:
        raise QueryError("assets: there is none; give at least one")
    files: dict[str, Content] = dict(_page_files())
    shown = [_shown(path) for path in paths]
    for path, each in zip(paths, shown, strict=True):
        for remark in each.remarks:
            say(f"{path}: {remark}")
    takes_light = any(each.takes_light for each in shown)
    if lights and not takes_light:
        say("the page shows the light that the asset was made for, and no other")
    objects = [{"name": _name(path, paths), "file": _add(files, path.name, path)} for path in paths]
    chosen = (_several(lights) or [example("sky.hdr")]) if takes_light else []
    entries = [_add_light(files, light, shown, mend, say) for light in chosen]
    description = {"generator": f"prtbake {program_version()}", "objects": objects, "lights": entries}
    listed = {"files": sorted({PurePosixPath(name).parts[0] for name in [*files, "site.json"]})}
    files["site.json"] = (as_text(description | listed) + "\n").encode()
    return files


def _name(path: Path, paths: list[Path]) -> str:
    """The stem of a file; of several with that stem, as `prtbake make` writes them, with the folder."""
    several = [each.stem for each in paths].count(path.stem) > 1
    return f"{path.resolve().parent.name}/{path.stem}" if several else path.stem


def _several(paths: Paths) -> list[str | Path]:
    return [paths] if isinstance(paths, str | Path) else list(paths)


def _page_files() -> Iterator[tuple[str, Path]]:
    """Yield the page's own files and those of its packages. Raises StorageError if `make site` has not been run."""
    vendor = PAGE / "vendor"
    if not (vendor / "VERSIONS").is_file():
        raise StorageError(
            f"{vendor}: the JavaScript packages of the page (three.js, h5wasm) are missing; run `make site` in the "
            "clone of prtbake, which needs npm, and install prtbake again, or install its wheel, which has them"
        )
    for path in sorted([*PAGE.iterdir(), *vendor.rglob("*")]):
        if path.is_file() and (path.suffix in _SUFFIXES or vendor in path.parents):
            yield path.relative_to(PAGE).as_posix(), path


def _shown(path: Path) -> _Shown:
    suffix = path.suffix.lower()
    if suffix == ".glb":
        return _shown_glb(path)
    if suffix not in (".h5", ".hdf5"):
        raise FormatError(f"{path}: expected an asset (.h5) or what `prtbake export` wrote (.glb), found {suffix!r}")
    with read_asset(path, load=False) as asset:
        _refuse_beyond_texture(path, asset.coefficients)
        remarks = []
        if asset.lobes is not None:
            remarks.append("its lobes are not shown: the page lights by harmonics")
        if not asset.complete:
            remarks.append("is a partial bake; vertices not yet baked are black")
        if any(item.get("item") == "other views" for item in asset.left_out):
            remarks.append("is baked for one camera position (--for-eye); from others the page shows it wrongly")
        return _Shown(asset.up, asset.mesh, asset.quantity == "transfer", tuple(remarks))


def _refuse_beyond_texture(path: Path, coefficients: Any) -> None:
    """Raise QueryError if an asset that is not compact has more coefficients than a browser holds on the GPU."""
    if isinstance(coefficients, CompactCoefficients):
        return
    vertices, bins, terms, channels = coefficients.shape
    texels = vertices * (bins + (bins > 1)) * math.ceil(terms * channels / 4)
    if texels > _MOST_TEXELS:
        raise QueryError(
            f"{path}: {vertices:,} vertices of {bins} view bins are {texels / _MOST_TEXELS:.1f} times what a browser "
            f"holds on the GPU; show a smaller form: prtbake compress {path} -o {path.with_suffix('.compact.h5')}"
        )


def _shown_glb(path: Path) -> _Shown:
    extras = glb_extras(path)
    if extras is None:
        raise FormatError(
            f"{path}: has no coefficients (meshes[0].extras.prtbake); write it with: "
            f"prtbake export ASSET.h5 -o {path.name}"
        )
    if not str(extras.get("version")).startswith("1."):
        raise FormatError(
            f"{path}: has version {extras.get('version')} of the layout; this program reads 1.x; "
            "use a newer version of prtbake"
        )
    return _Shown(str(extras.get("up", "y")), None, extras.get("quantity") != "radiance", ())


def _add(files: dict[str, Content], name: str, content: Content) -> str:
    """Add a file under a name that every web server and file system takes, and that is not used yet; return it."""
    plain = re.sub(r"[^A-Za-z0-9.-]+", "_", name).lstrip(".") or "file"
    path = PurePosixPath(plain)
    used, unique, number = {each.lower() for each in [*files, "site.json"]}, plain, 1
    while unique.lower() in used:
        number += 1
        unique = f"{path.stem}_{number}{path.suffix}"
    files[unique] = content
    return unique


def _add_light(
    files: dict[str, Content], light: str | Path, shown: list[_Shown], mend: bool, say: Callable[[str], None]
) -> dict[str, str]:
    first = next(each for each in shown if each.takes_light)
    picture, lighting = light_picture(light, first.up, first.mesh, mend=mend, say=say)
    name = str(light) if str(light).startswith(("sun:", "sphere:")) else Path(light).name
    if lighting.suns:
        if any(each.up != first.up for each in shown):
            raise QueryError(
                f"{light}: has a direction in object space, but some assets have y up and others z up; export them "
                "to folders of their own"
            )
        if any(not _same_suns(lighting, light, each) for each in shown if each.takes_light and each.mesh is not None):
            raise QueryError(
                f"{light}: is near the objects, which see it in different directions; export them to folders of their "
                "own"
            )
        say(f"{name}: the page lights by harmonics: suns look softer than in `prtbake shade`")
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "light.hdr"
        write_image(written, picture)
        stem = name if name.startswith(("sun:", "sphere:")) else Path(light).stem
        return {"name": name, "file": _add(files, f"{stem}.hdr", written.read_bytes())}


def _same_suns(lighting: Lighting, light: str | Path, shown: _Shown) -> bool:
    """Whether an object sees the suns of a light, and its spheres, where the first object does."""
    own = read_lighting([light], shown.up, mesh=shown.mesh, degree=0, say=lambda sentence: None)
    return all(np.allclose(a.direction, b.direction, atol=1e-6) for a, b in zip(own.suns, lighting.suns, strict=True))


def _refuse_other_folder(folder: Path, force: bool) -> None:
    """Raise StorageError if the folder exists, unless it is empty or, with `force`, all of an earlier export."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise StorageError(f"{folder}: expected a folder, found a file; choose another name")
    if folder.samefile(Path.cwd()) or folder.is_mount():
        raise StorageError(
            f"{folder}: is the current folder, or where a disk is mounted, and cannot be replaced; name a folder in it"
        )
    found = {path.name for path in folder.iterdir()} - _OF_SYSTEMS
    if not found:
        return
    try:
        own = {str(name) for name in json.loads((folder / "site.json").read_text(encoding="utf-8"))["files"]}
    except (OSError, ValueError, LookupError, TypeError):
        raise StorageError(f"{folder}: is not a folder that `prtbake export` wrote; choose a new folder") from None
    if other := sorted(found - own):
        raise StorageError(f"{folder}: has {other[0]}, which `prtbake export` did not write; choose a new folder")
    if not force:
        raise StorageError(f"{folder}: already exists; add --force to replace it")


def _write(target: Path, files: dict[str, Content]) -> None:
    """Write the files into a folder beside the target, then rename it."""
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", suffix=".part", dir=target.parent) as part:
        new, old = Path(part) / "new", Path(part) / "old"
        for name, content in files.items():
            path = new / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                shutil.copyfile(content, path)
        try:
            if target.exists():
                target.rename(old)
            new.rename(target)
        except BaseException:  # Ctrl-C, too: the temporary folder takes the old one with it
            if old.exists():
                old.rename(target)
            raise
