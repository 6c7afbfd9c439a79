"""docs/reference/scene_files.md agrees with the schema of scene files."""

import json
import re
import tomllib
from typing import Any

import pytest

from formats.scene.schema import InsideTable, InterfaceTable, MediumTable, MixTable, ObjectTable, SceneFile
from tests import ROOT

TEXT = (ROOT / "docs" / "reference" / "scene_files.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
COMPLETE = tomllib.loads(EXAMPLES[0])


def test_the_first_example_is_a_complete_scene() -> None:
    assert SceneFile.model_validate(COMPLETE).object.mesh == "glass.obj"


@pytest.mark.parametrize("example", EXAMPLES[1:], ids=[text.splitlines()[0] for text in EXAMPLES[1:]])
def test_every_other_example_is_valid_within_it(example: str) -> None:
    tables: dict[str, Any] = tomllib.loads(example)
    if set(tables.get("medium", {})) == {"mix"}:
        tables["medium"] = COMPLETE["medium"] | tables["medium"]
    SceneFile.model_validate(COMPLETE | tables)


@pytest.mark.parametrize("table", [SceneFile, ObjectTable, InterfaceTable, MediumTable, MixTable, InsideTable])
def test_every_key_appears_in_an_example_and_in_a_table(table: Any) -> None:
    text = "\n".join(EXAMPLES)
    for name, field in table.model_fields.items():
        key = field.alias or name
        assert re.search(rf"^(?:{key} = |\[+(?:\w+\.)?{key}\])", text, re.MULTILINE), key
        assert re.search(rf"^\|.*`{key}`.*\|$|^## \[+(?:\w+\.)?{key}\]", TEXT, re.MULTILINE), key


@pytest.mark.parametrize("table", [ObjectTable, InterfaceTable, MediumTable, MixTable])
def test_tables_have_the_defaults(table: Any) -> None:
    defaults = {key: field.default for key, field in table.model_fields.items() if not field.is_required()}
    for key, default in defaults.items():
        if default is not None:
            cells = re.findall(rf"^\|[^|]*`{key}`.*\| ([^|]*) \|$", TEXT, re.MULTILINE)
            words = f"{default:g}" if isinstance(default, float) else json.dumps(default)  # as TOML writes it
            assert any(re.search(rf"(?<!\S){re.escape(words)}(?![\w.])", cell) for cell in cells), (key, cells)
