"""Checkpoint files: a JSON text and named tensors, as `.pt` (torch's zip) or `.safetensors`.

Neither form can run code when it is read: `.pt` goes through torch's restricted unpickler (`weights_only=True`),
`.safetensors` holds no code by construction (https://github.com/huggingface/safetensors#format).
"""

import io
import pickle
import warnings
import zipfile
from pathlib import Path

import torch
from torch import Tensor

from formats.atomic import replacing
from formats.errors import ModelError

HEAD = "prtbake"
_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_MAX_RATIO = 20
"""Most bytes that a `.pt` unpacks to, per byte of the file; torch stores the entries uncompressed."""
_OF_A_FUNCTION = (
    "which only `prtbake bake` and `prtbake lobes` take; describe its 7 inputs there with --convention, "
    'for example --convention "incident, position, outgoing"'
)


def write_checkpoint(path: str | Path, head: str, tensors: dict[str, Tensor]) -> None:
    """Writes JSON text `head` and CPU tensors to `path`, atomically.

    Raises ModelError on a suffix other than .pt and .safetensors, StorageError if the file cannot be written.
    """
    suffix = _suffix(path)
    with replacing(Path(path)) as temporary:
        if suffix == ".safetensors":
            from safetensors.torch import save

            temporary.write_bytes(save(tensors, metadata={HEAD: head}))
        else:
            # Through memory: on a full disk torch's own writer fails with other errors than OSError.
            content = io.BytesIO()
            torch.save({HEAD: head, "tensors": tensors}, content)
            temporary.write_bytes(content.getvalue())


def read_checkpoint(path: str | Path) -> tuple[str, dict[str, Tensor]]:
    """The JSON text and the tensors of a checkpoint; raises ModelError that says what else the file is."""
    path = Path(path)
    if path.suffix.lower() == ".onnx" and path.is_file():
        raise ModelError(f"{path}: an ONNX function, {_OF_A_FUNCTION}")
    suffix = _suffix(path)
    if not path.is_file():
        raise ModelError(f"{path}: no such file; expected a model (.pt or .safetensors)")
    return _read_safetensors(path) if suffix == ".safetensors" else _read_pt(path)


def check_tensors(tensors: dict[str, Tensor], shapes: dict[str, tuple[int, ...]], path: str | Path) -> None:
    """Raises ModelError unless `tensors` have exactly the names and `shapes`, and values finite in float32."""
    for name in sorted(shapes.keys() | tensors.keys()):
        if name not in tensors or name not in shapes:
            state = "missing" if name in shapes else "not part of this network"
            raise ModelError(f"{path}: tensor {name} is {state}")
        found = tuple(tensors[name].shape)
        if found != shapes[name]:
            raise ModelError(f"{path}: tensor {name} has shape {found}, expected {shapes[name]}")
        if tensors[name].dtype not in _FLOATS:
            raise ModelError(f"{path}: tensor {name} holds {tensors[name].dtype}, expected floats of 16, 32 or 64 bits")
        bad = int((~tensors[name].float().isfinite()).sum())
        if bad:
            raise ModelError(f"{path}: tensor {name} holds {bad} values that are not finite in float32")


def check_entries(path: Path) -> None:
    """Compare the entries of a `.pt` with their CRC-32, which `torch.load` does not do.

    Raises ModelError naming the entry. Files without a zip's directory (older forms, truncated ones) are left to
    `torch.load`.
    """
    try:
        if not zipfile.is_zipfile(path):
            return
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > _MAX_RATIO * path.stat().st_size:
                raise ModelError(
                    f"{path}: its entries unpack to {unpacked} bytes from a file of {path.stat().st_size}; "
                    "expected a model written by prtbake, which is not compressed"
                )
            damaged = archive.testzip()
    except ModelError:
        raise
    except Exception as fault:  # zipfile raises errors of many classes on foreign and damaged files
        raise ModelError(f"{path}: not a readable .pt file ({_first_line(fault)}); copy it again") from None
    if damaged is not None:
        raise ModelError(f"{path}: the entry {damaged} is damaged: its checksum differs; copy the file again")


def _read_pt(path: Path) -> tuple[str, dict[str, Tensor]]:
    check_entries(path)
    try:
        with warnings.catch_warnings():
            # Warnings about foreign pickles; unsound content is refused below.
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as fault:  # torch's restricted reader raises many types of errors on foreign files
        raise ModelError(f"{path}: {_diagnosis(fault)}") from None
    head, tensors = (content.get(HEAD), content.get("tensors")) if isinstance(content, dict) else (None, None)
    if not isinstance(head, str) or not isinstance(tensors, dict):
        raise ModelError(f"{path}: a checkpoint of another program; expected a model written by prtbake")
    for name, tensor in tensors.items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise ModelError(f"{path}: {name!r} is not a named tensor; expected a model written by prtbake")
        if not _is_plain(tensor):
            raise ModelError(
                f"{path}: tensor {name} is sparse, nested, or without values of its own; expected a plain tensor; "
                "train the model again"
            )
    return head, tensors


def _is_plain(tensor: Tensor) -> bool:
    """Whether every value of a tensor is stored: no sparse, nested or repeated ones, and no mere shape ("meta")."""
    if tensor.layout != torch.strided or tensor.is_nested or tensor.device.type != "cpu":
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _diagnosis(fault: Exception) -> str:
    if "TorchScript" in str(fault):
        return f"a TorchScript function, {_OF_A_FUNCTION}"
    if isinstance(fault, pickle.UnpicklingError):
        return "is no file of plain weights and was refused; none of its code ran; expected a model written by prtbake"
    if isinstance(fault, OSError | MemoryError):
        return f"cannot be read ({_first_line(fault)}); copy it again"
    return "not a readable checkpoint: truncated, or not a .pt file; expected a model written by prtbake"


def _read_safetensors(path: Path) -> tuple[str, dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            head = (file.metadata() or {}).get(HEAD)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as fault:
        raise ModelError(f"{path}: not a readable .safetensors file ({_first_line(fault)}); copy it again") from None
    if head is None:
        raise ModelError(f"{path}: a .safetensors file of another program; expected a model written by prtbake")
    return head, tensors


def refuse_other_suffix(path: str | Path) -> None:
    """Raise ModelError if a file of this name cannot be a model."""
    _suffix(path)


def _suffix(path: str | Path) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in (".pt", ".safetensors"):
        raise ModelError(f"{path}: a model's name ends in .pt or .safetensors, found {suffix or 'no suffix'!r}")
    return suffix


def _first_line(fault: Exception) -> str:
    return (str(fault).splitlines() or [type(fault).__name__])[0][:200]
