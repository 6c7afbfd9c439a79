"""What a training run needs to go on: `NAME.train.pt` beside the model, plain tensors and numbers only."""

import io
from pathlib import Path
from typing import Any

from formats.atomic import replacing
from formats.errors import ModelError

_VERSION = 3


def state_path(output: str | Path) -> Path:
    """Where the state of the run that writes `output` lies."""
    output = Path(output)
    return output.with_name(output.stem + ".train.pt")


def require_state(output: str | Path) -> Path:
    """Where that state lies; raises ModelError where there is none."""
    path = state_path(output)
    if not path.is_file():
        raise ModelError(f"{path}: not found; there is nothing to resume, train without --resume")
    return path


def write_state(output: str | Path, state: dict[str, Any]) -> None:
    """Write the state, whole or not at all; it holds `scene`, and in `begun` all that a run keeps to its end."""
    import torch

    content = io.BytesIO()
    torch.save({"version": _VERSION, **state}, content)
    with replacing(state_path(output)) as part:
        part.write_bytes(content.getvalue())


def read_state(output: str | Path, scene_hash: str, begun: dict[str, Any]) -> dict[str, Any]:
    """Read the state of a run that was begun with the same scene and with `begun`.

    Raises ModelError where there is none, where it is damaged, and where it is of another scene or begun otherwise,
    saying in what.
    """
    import torch

    path = require_state(output)
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        found, version = state["scene"], state.get("version")
    except Exception as fault:
        raise ModelError(
            f"{path}: not a readable training state ({type(fault).__name__}); train without --resume"
        ) from None
    if found != scene_hash:
        raise ModelError(
            f"{path}: belongs to another scene (the mesh, medium or interface changed); train without --resume"
        )
    if version != _VERSION:
        raise ModelError(f"{path}: is of version {version!r}, expected {_VERSION}; train without --resume")
    for name, value in begun.items():
        if state["begun"].get(name) != value:
            raise ModelError(
                f"{path}: was begun with {name} {state['begun'].get(name)!r}, asked for is {value!r}; "
                "ask for the same, or train without --resume"
            )
    return state
