"""The files of the project on a forge: versions agree, and workflows call targets of the Makefile."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests import ROOT
from tests.documents.checks import command_faults

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))


def test_hooks_have_the_versions_of_the_project() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    pinned = {repo["repo"].rpartition("/")[2]: repo["rev"] for repo in hooks["repos"] if repo["repo"] != "local"}
    required = dict(re.findall(r"^(\w+)==(\S+)$", "\n".join(PROJECT["optional-dependencies"]["dev"]), re.MULTILINE))
    assert pinned == {"ruff-pre-commit": f"v{required['ruff']}"}


def test_the_citation_has_the_version_and_license_of_the_project() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (citation["version"], citation["license"]) == (PROJECT["version"], PROJECT["license"])


def jobs(path: Path) -> list[Any]:
    return list(yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values())


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_run_targets_of_the_makefile_alone(path: Path) -> None:
    commands = [step["run"] for job in jobs(path) for step in job["steps"] if "run" in step]
    assert [command for command in commands if not command.startswith("make ")] == []
    blocks = [f"```sh\n{re.sub(r'[$]{{.*?}}', 'v1', command)}\n```" for command in commands]
    assert command_faults("\n".join(blocks)) == []
    assert all("timeout-minutes" in job for job in jobs(path))


def test_every_python_of_the_project_is_tested() -> None:
    (tested,) = (job["strategy"]["matrix"]["python"] for path in WORKFLOWS for job in jobs(path) if "strategy" in job)
    named = [name.rpartition(" ")[2] for name in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", name)]
    assert tested == named


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.name)
def test_forms_are_yaml_with_named_fields(path: Path) -> None:
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert all("id" in field and "label" in field["attributes"] for field in form.get("body", []))
