"""What a training run needs to go on: `NAME.train.pt` beside the model, plain tensors and numbers only."""

import io
from pathlib import Path
from typing import Any

from formats.errors import ModelError
from formats.whole import replacing


def state_path(output: str | Path) -> Path:
    """Where the state of the run that writes `output` lies."""
    output = Path(output)
    return output.with_name(output.stem + ".train.pt")


def write_state(output: str | Path, state: dict[str, Any]) -> None:
    """Write the state, whole or not at all."""
    import torch

    content = io.BytesIO()
    torch.save(state, content)
    with replacing(state_path(output)) as part:
        part.write_bytes(content.getvalue())


def read_state(output: str | Path, scene_hash: str) -> dict[str, Any]:
    """Read the state; raises ModelError where there is none, where it is damaged or where it is of another scene."""
    import torch

    path = state_path(output)
    if not path.is_file():
        raise ModelError(f"{path}: not found; there is nothing to resume, train without --resume")
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        found = state["scene"]
    except Exception as fault:
        raise ModelError(
            f"{path}: not a readable training state ({type(fault).__name__}); train without --resume"
        ) from None
    if found != scene_hash:
        raise ModelError(
            f"{path}: belongs to another scene (the mesh, medium or interface changed); train without --resume"
        )
    return state
