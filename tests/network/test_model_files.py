"""Files of models: damaged, hostile, foreign and inconsistent ones are refused by name."""

import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from formats.errors import ModelError
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, load_model, save_model
from tests.network.test_bssrdf import SMALL, rough_interior


class Hostile:
    """Would write a file when unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (str(self.target), "w")


def test_a_hostile_pickle_is_refused_and_never_runs(tmp_path: Path) -> None:
    target = tmp_path / "it ran"
    torch.save({"prtbake": "{}", "tensors": Hostile(target)}, tmp_path / "model.pt")
    with pytest.raises(ModelError, match=r"model\.pt.*refused"):
        load_model(tmp_path / "model.pt")
    (tmp_path / "bare.pt").write_bytes(pickle.dumps(Hostile(target)))
    with pytest.raises(ModelError, match=r"bare\.pt"):
        load_model(tmp_path / "bare.pt")
    assert not target.exists()


def damaged(tmp_path: Path, change: dict[str, object]) -> Path:
    """The file of a small model with some tensors replaced (None: removed)."""
    path = tmp_path / "model.pt"
    save_model(NeuralBSSRDF(NetworkSettings(**SMALL)), path)
    content = torch.load(path, weights_only=True)
    for name, tensor in change.items():
        content["tensors"][name] = tensor
    content["tensors"] = {name: tensor for name, tensor in content["tensors"].items() if tensor is not None}
    torch.save(content, path)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"hidden.2.weight": torch.full((16, 32), torch.nan)},
            r"hidden\.2\.weight holds 512 values that are not finite",
        ),
        ({"hidden.1.bias": torch.zeros(15)}, r"hidden\.1\.bias has shape \(15,\), expected \(16,\)"),
        ({"output.bias": None}, r"output\.bias is missing"),
        ({"extra": torch.zeros(2)}, r"extra is not part"),
        ({"output.bias": torch.zeros(3, dtype=torch.int32)}, r"output\.bias holds torch\.int32"),
        ({"output.bias": torch.zeros(3, dtype=torch.float8_e4m3fn)}, r"output\.bias holds torch\.float8_e4m3fn"),
        (
            {"output.bias": torch.full((3,), 1e300, dtype=torch.float64)},
            r"output\.bias holds 3 values that are not finite in float32",
        ),
        ({"output.bias": torch.empty(3, device="meta")}, r"output\.bias is sparse, nested, or without values"),
        ({"output.bias": torch.zeros(3).to_sparse()}, r"output\.bias is sparse, nested, or without values"),
        ({"output.bias": torch.zeros(1).expand(3)}, r"output\.bias is sparse, nested, or without values"),
        ({"output.bias": "words"}, r"'output\.bias' is not a named tensor"),
    ],
)
def test_unsound_weights_are_refused_by_name(tmp_path: Path, change: dict[str, object], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_model(damaged(tmp_path, change))


def test_a_changed_byte_is_refused_by_entry(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    save_model(NeuralBSSRDF(NetworkSettings(**SMALL)), path)
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda entry: entry.file_size)
    content[largest.header_offset + 200] ^= 1  # past the entry's header and padding
    path.write_bytes(content)
    with pytest.raises(ModelError, match=rf"model\.pt: the entry {largest.filename} is damaged: its checksum differs"):
        load_model(path)


def test_entries_that_unpack_to_far_more_than_the_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", pickle.dumps({}) + bytes(10**6))
    with pytest.raises(ModelError, match=r"model\.pt: its entries unpack to 10000\d\d bytes from a file of \d+;"):
        load_model(path)


@pytest.mark.parametrize(
    "setting",
    [
        "width",
        "layers",
        "features",
        "light_features",
        "ray_samples",
        "low_width",
        "low_layers",
        "correction_width",
        "lobes",
    ],
)
def test_settings_of_a_larger_network_than_the_file_are_refused(tmp_path: Path, setting: str) -> None:
    path = tmp_path / "model.pt"
    save_model(NeuralBSSRDF(PRESETS["measured"], interior=rough_interior(8)), path)
    content = torch.load(path, weights_only=True)
    head = json.loads(content["prtbake"])
    head["settings"][setting] = 10**12
    torch.save(content | {"prtbake": json.dumps(head)}, path)
    with pytest.raises(ModelError, match=r"model\.pt: its settings describe a larger network than its \d+ numbers"):
        load_model(path)


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("metadata", "eta"), "x", "metadata.eta is 'x'; expected an index of refraction"),
        (("metadata", "eta"), np.nan, "metadata.eta is nan; expected an index of refraction"),
        (("metadata", "eta"), -1, "metadata.eta is -1; expected an index of refraction"),
        (("metadata", "roughness"), "x", "metadata.roughness is 'x'; expected a GGX alpha"),
        (("metadata", "roughness"), -1, "metadata.roughness is -1; expected a GGX alpha"),
        (("metadata", "up"), "zzz", "metadata.up is 'zzz'; expected 'y' or 'z'"),
        (("metadata", "normals"), "zzz", "metadata.normals is 'zzz'; expected 'face' or 'vertex'"),
        (("metadata", "unit"), None, "metadata.unit is None; expected text"),
        (("metadata", "training"), [1], "metadata.training is .1.; expected a table"),
        (("metadata", "training"), {"relative_rmse": 1}, "metadata.training.relative_rmse is 1; expected a table"),
        (
            ("metadata", "training"),
            {"relative_rmse": {"coefficients": "x"}},
            "metadata.training.relative_rmse.coefficients is 'x'; expected an error",
        ),
        (
            ("metadata", "training"),
            {"relative_rmse": {"coefficients_interval": [0.2, 0.1]}},
            r"relative_rmse.coefficients_interval is \[0.2, 0.1\]; expected the ends of an interval, or null",
        ),
        (("output_scale",), 1e300, "output_scale positive and finite in float32; found .*1e.300"),
        (("box_side",), 1e300, "output_scale positive and finite in float32; found .*1e.300"),
        (("settings", "position_spread"), np.nan, "position_spread must be finite in float32, found nan"),
        (("interior", "spacing"), 1e300, "interior: corner and extent, in box sides, and eta must be at most 5"),
    ],
)
def test_wrong_values_of_the_description_are_refused(
    tmp_path: Path, keys: tuple[str, ...], value: object, message: str
) -> None:
    path = tmp_path / "model.pt"
    metadata = {"up": "z", "unit": "cm", "eta": 1.3, "roughness": 0, "normals": "vertex", "training": {}}
    save_model(NeuralBSSRDF(PRESETS["measured"], interior=rough_interior(8), metadata=metadata), path)
    assert load_model(path).metadata == metadata
    content = torch.load(path, weights_only=True)
    head = json.loads(content["prtbake"])
    table = head[keys[0]] if len(keys) == 2 else head
    table[keys[-1]] = value
    torch.save(content | {"prtbake": json.dumps(head)}, path)
    with pytest.raises(ModelError, match=rf"model\.pt: .*{message}"):
        load_model(path)


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_other_files_are_refused_by_name(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"model{suffix}"
    with pytest.raises(ModelError, match="no such file"):
        load_model(path)
    save_model(NeuralBSSRDF(NetworkSettings(**SMALL)), path)
    complete = path.read_bytes()
    for content in (b"", b"ply\nformat ascii 1.0\n", complete[: len(complete) // 2]):
        path.write_bytes(content)
        with pytest.raises(ModelError, match=f"model\\{suffix}: "):
            load_model(path)
    with pytest.raises(ModelError, match="ends in"):
        load_model(tmp_path / "model.onnx")


def test_a_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    torch.save({"weights": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(ModelError, match="a checkpoint of another program"):
        load_model(tmp_path / "other.pt")
