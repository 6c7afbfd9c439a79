"""Checkpoints of training runs: `NAME.train.pt` beside the model, made of tensors and plain values only."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.errors import ModelError, StorageError
from prt_bake.network.file_names import state_path

_VERSION = 6


def require_state(output: str | Path) -> Path:
    """Path of the checkpoint; raises ModelError if it does not exist."""
    path = state_path(output)
    if not path.is_file():
        raise ModelError(f"{path}: not found; there is nothing to resume, train without resume")
    return path


def write_state(output: str | Path, state: dict[str, Any]) -> None:
    """Write the checkpoint atomically; `state` has the hash of the `scene` and the fixed settings as `begun`."""
    import torch

    path = state_path(output)
    with replacing(path) as part:
        try:
            torch.save({"version": _VERSION, **state}, part)
        except RuntimeError as fault:
            if not any(words in str(fault) for words in ("PytorchStreamWriter", "unexpected pos")):
                raise
            # What torch's own writer says of a full disk.
            raise StorageError(
                f"{path}: the checkpoint cannot be written, perhaps because the disk is full; free some space or "
                "write elsewhere"
            ) from fault


def seconds_of(output: str | Path) -> float:
    """Wall time of the runs that a checkpoint continues; 0 if it cannot be read, which `read_state` then says."""
    import torch

    with suppress(Exception):
        state = torch.load(state_path(output), map_location="cpu", weights_only=True, mmap=True)
        return float(state.get("spent", state["seconds"]))
    return 0.0


def read_state(output: str | Path, scene_hash: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Read the checkpoint of a run that began with the same scene and the same settings.

    Raises ModelError if the checkpoint is missing or damaged, belongs to another scene, is of another kind of model, or
    began with other settings; the message names the setting.
    """
    import torch

    from prt_bake.network.checkpoint import check_entries

    path = require_state(output)
    check_entries(path)
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        found, version = state["scene"], state.get("version")
    except Exception as fault:
        raise ModelError(
            f"{path}: not a readable training state ({type(fault).__name__}); train without resume"
        ) from None
    if found != scene_hash:
        raise ModelError(
            f"{path}: belongs to another scene (the mesh, medium or interface changed); train without resume"
        )
    if version != _VERSION:
        raise ModelError(f"{path}: has version {version!r}, expected {_VERSION}; train without resume")
    for name, value in settings.items():
        if name not in state["begun"]:
            raise ModelError(
                f"{path}: the run trains a model of another kind; request the same --baseline, or none, "
                "or train without resume"
            )
        if state["begun"][name] != value:
            raise ModelError(
                f"{path}: the run began with {name} {state['begun'][name]!r}, requested is {value!r}; "
                "request the same, or train without resume"
            )
    return state
