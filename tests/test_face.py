"""The public face and the floors behind it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import prt_bake as prt

ROOT = Path(prt.__file__).resolve().parents[1]


def run_python(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)


def test_all_is_sorted_and_every_name_loads() -> None:
    assert prt.__all__ == sorted(prt.__all__)
    assert [name for name in prt.__all__ if getattr(prt, name, None) is None] == []


def test_names_of_the_design_are_there() -> None:
    promised = (
        "sh project_environment read_mesh read_image read_asset write_asset load_model load_scene bake shade"
        " estimate_transport estimate_coefficients train compare"
    )
    assert set(promised.split()) <= set(prt.__all__)


def test_type_checkers_see_the_names_that_are_loaded_on_demand() -> None:
    tree = ast.parse(Path(prt.__file__).read_text(encoding="utf-8"))
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    imported = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    loaded = {
        name: (module, attribute) if attribute else tuple(module.rsplit(".", 1))
        for name, (module, attribute) in prt._ORIGIN.items()
    }
    assert imported == loaded
    assert sorted(imported) == prt.__all__


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = prt.no_such_name


def test_importing_the_face_loads_nothing_heavy() -> None:
    program = (
        "import sys, prt_bake, prt_bake.cli.main\n"
        "heavy = {'numpy', 'torch', 'numba', 'trimesh', 'h5py', 'OpenEXR', 'pydantic', 'rich', 'scipy'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    ran = run_python(program)
    assert (ran.returncode, ran.stdout.strip(), ran.stderr) == (0, "[]", "")


def test_shading_and_everything_it_asks_for_load_no_torch() -> None:
    program = (
        "import sys\n"
        "import prt_bake as prt\n"
        "import prt_bake.geometry.camera, prt_bake.shading.picture\n"
        "prt.shade, prt.read_asset, prt.write_asset, prt.read_mesh, prt.read_image\n"
        "prt.project_environment, prt.bake, prt.load_scene\n"
        "print('torch' in sys.modules)"
    )
    ran = run_python(program)
    assert (ran.returncode, ran.stdout.strip()) == (0, "False"), ran.stderr


def test_the_floors_hold() -> None:
    from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == EXIT_STATUS_SUCCESS
