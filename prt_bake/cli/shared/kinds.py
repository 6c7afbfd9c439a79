"""Files of another kind than a command expects: which kind they are, and the command that they are for."""

import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from formats.errors import FormatError, PrtbakeError

SOURCE, LIGHT = ("model", "scene"), ("sky", "lights")
"""The kinds of what is baked and rendered, and of what gives light."""
Expected = tuple[Path | str | Iterable[Path | str] | None, tuple[str, ...]]
"""The value of an argument or option, and the kinds that it may be."""

_NAMES = {
    "mesh": "a mesh",
    "sky": "a picture",
    "scene": "a scene",
    "lights": "a lights file",
    "model": "a model",
    "importance": "an importance module",
    "checkpoint": "the checkpoint of a training",
    "asset": "an asset",
    "samples": "training samples",
}
_REMEDIES = {
    ("asset", "model"): "bake it first: prtbake bake {file} MESH -o {h5}",
    ("asset", "mesh"): "begin with a scene of it: prtbake init {file} --material NAME",
    ("scene", "mesh"): "begin with a scene of it: prtbake init {file} --material NAME",
    ("asset", "scene"): "train a model on it first: prtbake train {file} -o {pt}",
    ("source", "asset"): "it is baked already; show it: prtbake view {file}",
    ("source", "mesh"): "the mesh comes second; without a scene begin with: prtbake init {file} --material NAME",
    ("scene", "model"): "it is trained already; bake it: prtbake bake {file} MESH -o {h5}",
    ("scene", "asset"): "it is baked already; show it: prtbake view {file}",
    ("model", "scene"): "train one on it first: prtbake train {file} -o {pt}",
    ("model", "asset"): "give the model that it was baked from",
    ("mesh", "scene"): "give the mesh that the scene names",
    ("mesh", "model"): "give the mesh that it was trained on",
    ("mesh", "asset"): "give the mesh that it was baked on",
    ("sky", "asset"): "make a picture of it first: prtbake shade {file} --light SKY -o {exr}",
    ("light", "scene"): "its lights must be in a file of their own",
    ("light", "asset"): "light it: prtbake shade {file} --light SKY -o {png}",
}
_OF_THE_FOUND = {
    "sky": "a picture can be the light: prtbake shade ASSET --light {file} -o PICTURE.png",
    "lights": "light an asset with it: prtbake shade ASSET --light {file} -o PICTURE.png",
    "samples": "train with them: prtbake train SCENE.toml --samples {file} -o MODEL.pt",
    "importance": "`prtbake render` finds it beside its model, {of_model}",
    "checkpoint": "prtbake train --resume reads it; its model is {of_checkpoint}",
}
_OF_THE_EXPECTED = {
    "model": "train one: prtbake train SCENE.toml -o MODEL.pt",
    "sky": "a picture is a .exr, .hdr, .png or .jpg file",
    "light": "only pictures, lights files and lights such as sun:0,1,0 can be lights",
    "samples": "make some: prtbake sample SCENE.toml --count N -o SAMPLES.h5",
}


def refuse_other_kinds(arguments: Mapping[str, Expected]) -> None:
    """Refuse files that are evidently of another kind than their argument or option expects.

    A file whose kind its name and its first bytes do not tell is left to the reader.

    Args:
        arguments: value and expected kinds by argument or option. Kinds are those of `kind_of` in inspection, lights
            and checkpoint.

    Raises FormatError that names the file, both kinds, and the command that the file is for.
    """
    for argument, (paths, kinds) in arguments.items():
        for path in _paths(paths):
            found = _kind(path)
            if found is not None and found not in kinds:
                raise FormatError(
                    f"{path}: expected {' or '.join(_NAMES[kind] for kind in kinds)} ({argument}), "
                    f"found {_NAMES[found]}; {_remedy(_role(kinds), found, path)}"
                )


def _role(kinds: tuple[str, ...]) -> str:
    return "source" if kinds == SOURCE else "light" if kinds == LIGHT else kinds[0]


def _remedy(role: str, found: str, path: Path) -> str:
    text = _REMEDIES.get((role, found)) or _OF_THE_FOUND.get(found) or _OF_THE_EXPECTED[role]
    named = {suffix: shlex.quote(f"{path.stem}.{suffix}") for suffix in ("h5", "pt", "exr", "png")}
    return text.format(
        file=shlex.quote(str(path)),
        of_model=_beside(path, ".importance"),
        of_checkpoint=_beside(path, ".train"),
        **named,
    )


def _beside(path: Path, mark: str) -> str:
    """Return the model that a file such as NAME.train.pt lies beside."""
    return shlex.quote(str(path.with_name(path.stem.removesuffix(mark) + path.suffix)))


def _paths(paths: Path | str | Iterable[Path | str] | None) -> Iterator[Path]:
    for path in [paths] if isinstance(paths, Path | str) else paths or []:
        try:
            if Path(path).is_file():
                yield Path(path)
        except (OSError, ValueError):
            continue  # a light such as sun:0,1,0, or a name that no file can have


def _kind(path: Path) -> str | None:
    """Return the kind of a file; None if it is not evident."""
    from prt_bake.inspection.files import CHECKPOINT, kind_of, kind_of_toml

    if path.name.lower().endswith(CHECKPOINT):
        return "checkpoint"
    try:
        kind = kind_of(path)
    except (PrtbakeError, OSError):
        return None
    return kind_of_toml(path) if path.suffix.lower() == ".toml" else kind
