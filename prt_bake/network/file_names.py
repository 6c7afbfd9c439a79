"""The names of the files beside a model. Loads without torch, so that a command can check them at once."""

from pathlib import Path


def importance_path(model: str | Path) -> Path:
    """Path of a model's importance module: NAME.importance.pt beside NAME.pt, and the same for .safetensors."""
    path = Path(model)
    return path.with_name(f"{path.stem}.importance{path.suffix}")


def report_paths(model: str | Path) -> tuple[Path, Path]:
    """Paths of the report of MODEL.pt: MODEL.report.json and MODEL.report.html beside it."""
    path = Path(model)
    return path.with_name(path.stem + ".report.json"), path.with_name(path.stem + ".report.html")


def state_path(model: str | Path) -> Path:
    """Path of the checkpoint of the training of MODEL.pt: MODEL.train.pt beside it."""
    path = Path(model)
    return path.with_name(path.stem + ".train.pt")
