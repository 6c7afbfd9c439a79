"""The files of the page: every import leads to one that is carried, and every carried module is imported."""

import json
import posixpath
import re
from pathlib import Path

from prt_bake.export.site import PAGE

PACKAGE = json.loads((PAGE / "package.json").read_text(encoding="utf-8"))
INDEX = (PAGE / "index.html").read_text(encoding="utf-8")
MAP = json.loads(re.findall(r'<script type="importmap">(.*?)</script>', INDEX, re.DOTALL)[0])["imports"]
CARRIED = {f"vendor/{name}" for name in PACKAGE["vendor"]} | {path.name for path in PAGE.glob("*.js")}
_IMPORT = re.compile(r"""^(?![ \t]*(?:\*|//)).*?(?:\bfrom|\bimport)\s*\(?\s*["']([^"'\n]+)["']""", re.MULTILINE)


def imports(path: Path) -> set[str]:
    """What a module imports, as names below the page's folder."""
    names = set()
    for found in _IMPORT.findall(path.read_text(encoding="utf-8")):
        prefix = max(
            (key for key in MAP if found == key or (key.endswith("/") and found.startswith(key))), default=None
        )
        if prefix is not None:
            names.add(posixpath.normpath(MAP[prefix] + found[len(prefix) :]))
        elif found.startswith("."):
            names.add(posixpath.normpath(posixpath.join(path.relative_to(PAGE).parent.as_posix(), found)))
    return names


def test_every_import_is_carried_and_every_carried_module_is_imported() -> None:
    """Without `make site` the imports inside of packages are not seen."""
    reached, waiting = set(), {"viewer.js"}
    while waiting:
        name = waiting.pop()
        reached.add(name)
        if (PAGE / name).is_file():
            waiting |= imports(PAGE / name) - reached
    assert reached <= CARRIED
    if (PAGE / "vendor").is_dir():
        assert {name for name in CARRIED if name.endswith(".js")} == reached
