"""The public names of `prt_bake`, what importing them loads, and the layers of packages."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import prt_bake as prt

ROOT = Path(prt.__file__).resolve().parents[1]
ROOMS = sorted(path.parent for path in (ROOT / "prt_bake").rglob("__init__.py"))


def run_python(program: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)


def test_all_is_sorted_and_every_name_loads() -> None:
    assert prt.__all__ == sorted(prt.__all__)
    assert [name for name in prt.__all__ if getattr(prt, name, None) is None] == []


def test_the_documented_names_exist() -> None:
    documented = (
        "sh project_environment read_mesh read_image read_asset write_asset load_model load_scene bake shade"
        " estimate_transport estimate_coefficients train compare"
    )
    assert set(documented.split()) <= set(prt.__all__)


def test_type_checkers_and_lazy_loading_agree_on_every_name() -> None:
    tree = ast.parse(Path(prt.__file__).read_text(encoding="utf-8"))
    type_checking = next(node for node in tree.body if isinstance(node, ast.If))
    imported = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in type_checking.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    loaded = {
        name: (module, attribute) if attribute else tuple(module.rsplit(".", 1))
        for name, (module, attribute) in prt._ORIGIN.items()
    }
    assert imported == loaded
    assert sorted(imported) == prt.__all__


def test_an_unknown_name_raises_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = prt.no_such_name


def test_importing_prt_bake_loads_no_large_package() -> None:
    program = (
        "import sys, prt_bake, prt_bake.cli.main\n"
        "large = {'numpy', 'torch', 'numba', 'trimesh', 'h5py', 'OpenEXR', 'pydantic', 'rich', 'scipy'}\n"
        "print(sorted(large & set(sys.modules)))"
    )
    ran = run_python(program)
    assert (ran.returncode, ran.stdout.strip(), ran.stderr) == (0, "[]", "")


def test_shading_and_its_imports_load_no_torch() -> None:
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


def test_the_import_contracts_hold() -> None:
    from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == EXIT_STATUS_SUCCESS


@pytest.mark.parametrize(
    "room", sorted(path.parent for path in (ROOT / "prt_bake").rglob("__init__.py")), ids=lambda room: room.name
)
def test_a_room_describes_itself_and_its_names_load(room: Path) -> None:
    module = importlib.import_module(".".join(room.relative_to(ROOT).parts))
    assert len((module.__doc__ or "").strip().splitlines()) in range(1, 11)
    assert [name for name in getattr(module, "__all__", []) if not hasattr(module, name)] == []
