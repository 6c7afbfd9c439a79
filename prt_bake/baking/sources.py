"""Files that can be baked: networks, TorchScript and ONNX functions, and scenes."""

from pathlib import Path
from typing import Any

from formats.atomic import existing, sha256
from formats.errors import FormatError, QueryError
from formats.mesh import Mesh
from formats.scene import read_scene
from prt_bake.baking.path_traced import PathTraced
from prt_bake.tracer.gpu.availability import require_walks_on


def open_source(path: str | Path, mesh: Mesh, device: str = "cpu", convention: str | None = None) -> Any:
    """The transport in a file, to be baked on `mesh`.

    convention: meaning of the seven inputs of a TorchScript or an ONNX function (`prt_bake.network.functions`), in the
    bounding box of the mesh; without it a `.pt` file is a network that `prt_bake.train` wrote.

    Raises:
        FormatError: an unknown suffix.
        PrtbakeError: the file is missing, damaged or unsafe, or the device does not exist.
    """
    suffix = existing(path).suffix.lower()
    if suffix == ".toml":
        require_walks_on(device)
        return PathTraced(read_scene(path), "cpu" if device == "cpu" else "cuda")
    require_device(device)
    if suffix not in (".pt", ".safetensors", ".onnx"):
        raise FormatError(
            f"{path}: expected a model (.pt, .safetensors), a function (.onnx) or a scene (.toml), found {suffix!r}"
        )
    if convention is not None:
        from prt_bake.network.functions import load_function

        low, high = mesh.bounds
        return load_function(path, convention, low, float((high - low).max()))
    from prt_bake.network.bssrdf import load_model

    return load_model(path, device)


def own_mesh(path: str | Path, convention: str | None = None) -> Path:
    """The mesh file of a scene, or of the scene that a model was trained on.

    That scene is looked for by its name, beside the model and in the current folder. Raises QueryError if it is not
    there or has changed since.
    """
    source = existing(path)
    if source.suffix.lower() == ".toml":
        return read_scene(source).mesh_path
    if convention is not None:
        raise QueryError(f"{path}: a function does not know its mesh; give the mesh after it")
    from prt_bake.network.bssrdf import load_model

    metadata = load_model(source).metadata
    name = metadata.get("scene")
    if name is None:
        raise QueryError(f"{path}: the model does not know its scene's mesh; give the mesh after it")
    for scene in (source.parent / name, Path(name)):
        if not scene.is_file():
            continue
        found = read_scene(scene)
        if found.content_hash == metadata.get("scene_hash"):
            return found.mesh_path
        raise QueryError(f"{path}: its scene {scene} has changed since the training; give the mesh after the model")
    raise QueryError(f"{path}: the model's scene {name} is not beside it; give the mesh after the model")


def require_device(device: str) -> None:
    """Raises QueryError if networks cannot run on `device`, "cpu" or "cuda"."""
    if device == "cpu":
        return
    import torch

    if device != "cuda" or not torch.cuda.is_available():
        raise QueryError(
            f"device: expected 'cpu', or 'cuda' with a GPU that the installed torch can use, found {device!r}; "
            f"give 'cpu'"
        )


def origin(path: str | Path) -> dict[str, str]:
    """Name and SHA-256 of a source file, for provenance; also the SHA-256 of the weights beside NAME.onnx."""
    weights = Path(f"{path}.data")
    beside = Path(path).suffix.lower() == ".onnx" and weights.is_file()
    hashes = {"source_sha256": sha256(path)} | ({"source_data_sha256": sha256(weights)} if beside else {})
    return {"source": Path(path).name, **hashes}
