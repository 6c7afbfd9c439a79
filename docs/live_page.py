"""The gallery's live page: `prtbake export` of its small assets into the site, if `make site` has been run.

A page says `<!-- live page -->` where the link to it stands. Without the live page that stays an invisible comment.
"""

import json
import shutil
import sys
import tempfile
import tomllib
from pathlib import Path

from sphinx.application import Sphinx

from formats.errors import StorageError
from formats.json_report import as_text
from prt_bake.export.site import export_site

DOCS = Path(__file__).resolve().parent
MARK = "<!-- live page -->"
LINK = '<p><a class="reference internal" href="live/index.html">Turn the objects and their light in the browser</a></p>'
BACK = [-0.43, 0.24, -0.87]
"""From where the page first looks at objects that face to the back, y up."""
WITHOUT = "docs: the site is built without the live page of the gallery"


def connect(app: Sphinx) -> None:
    """Write the live page when a build begins, and the link to it into the pages that have the mark."""
    links: list[str] = []

    def write(app: Sphinx) -> None:
        if app.builder.format == "html" and write_live(Path(app.outdir) / "live"):
            links.append(LINK)

    def insert(_: Sphinx, name: str, source: list[str]) -> None:
        if links:
            source[0] = source[0].replace(MARK, links[0])

    app.connect("builder-inited", write)
    app.connect("source-read", insert)
    app.connect("env-get-outdated", lambda *_: marked())


def write_live(folder: Path) -> bool:
    """Export the scenes of gallery.toml that have an asset in gallery/live; say why if the page cannot be made."""
    shutil.rmtree(folder, ignore_errors=True)
    gallery = tomllib.loads((DOCS / "gallery" / "gallery.toml").read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as titled:
        assets = []
        for scene in gallery["scene"]:
            asset = DOCS / "gallery" / "live" / f"{scene['name']}.h5"
            if asset.is_file():
                assets.append(shutil.copy(asset, Path(titled) / f"{scene['title']}.h5"))
        lights = [light if light.startswith("sun:") else DOCS.parent / light for light in gallery["live"]["lights"]]
        try:
            export_site(assets, folder, lights, say=lambda _: None)
        except StorageError as fault:
            sys.stderr.write(f"{WITHOUT}: {fault}\n")
            return False
    _show_faces(folder / "site.json", {scene["title"] for scene in gallery["scene"] if scene.get("back")})
    return True


def _show_faces(site: Path, turned: set[str]) -> None:
    """Let the page begin in front of the objects that look to the back, by the key `from` of the page."""
    described = json.loads(site.read_text(encoding="utf-8"))
    for entry in described["objects"]:
        if entry["name"] in turned:
            entry["from"] = BACK
    site.write_text(as_text(described) + "\n", encoding="utf-8")


def marked() -> list[str]:
    """The pages with the mark, which are read in every build, since the live page may come and go."""
    return [page.stem for page in sorted(DOCS.glob("*.md")) if MARK in page.read_text(encoding="utf-8")]
