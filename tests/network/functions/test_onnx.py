"""ONNX files as transports: what exporters write, agreement with TorchScript, and refused files."""

import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx import TensorProto, helper

from formats.errors import ModelError, PrtbakeError
from prt_bake.baking.bake import bake
from prt_bake.network.functions import load_function
from tests.bakers.transports import icosphere

FLOAT, INT64 = TensorProto.FLOAT, TensorProto.INT64
LIGHT = np.array([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [0.0, -0.6, -0.8]])
POSITIONS = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


def write(path: Path, inputs: Any, outputs: Any, nodes: Any = None, constants: Any = (), **model: Any) -> Path:
    """A file of tensors (name, type, shape); by default it returns the first three inputs, as y."""
    numbers = [helper.make_tensor(name, INT64, [len(value)], value) for name, value in [*SLICE, *constants]]
    graph = helper.make_graph(
        nodes or [helper.make_node("Slice", ["x", "begin", "end", "axis"], ["y"])],
        "hand-written",
        *([helper.make_tensor_value_info(*each) for each in tensors] for tensors in (inputs, outputs)),
        initializer=numbers,
    )
    versions = {"opset_imports": [helper.make_opsetid("", 17)], "ir_version": 8} | model
    path.write_bytes(helper.make_model(graph, **versions).SerializeToString())
    return path


SLICE = [("begin", [0]), ("end", [3]), ("axis", [1])]
X, Y = ("x", FLOAT, ["n", 7]), ("y", FLOAT, ["n", 3])


def network() -> torch.nn.Module:
    torch.manual_seed(3)
    return torch.nn.Sequential(torch.nn.Linear(7, 16), torch.nn.ReLU(), torch.nn.Linear(16, 3), torch.nn.Softplus())


def export(path: Path, **options: Any) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's exporters use what torch calls deprecated
        torch.onnx.export(network().eval(), (torch.rand(4, 7),), str(path), verbose=False, **options)
    return path


def torchscript(path: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.trace(network(), torch.rand(4, 7)), str(path))
    return path


EXPORTS: dict[str, dict[str, Any]] = {
    "by tracing": {"dynamo": False, "input_names": ["rows"], "dynamic_axes": {"rows": {0: "n"}}},
    "by tracing, four rows": {"dynamo": False},
    "by dynamo": {"dynamo": True, "dynamic_shapes": ({0: torch.export.Dim("n")},)},
    "by dynamo, four rows": {"dynamo": True},
    "by dynamo, in one file": {"dynamo": True, "external_data": False},
}


@pytest.mark.parametrize("how", EXPORTS)
def test_onnx_and_torchscript_of_one_network_agree(how: str, tmp_path: Path) -> None:
    of_onnx = load_function(export(tmp_path / "net.onnx", **EXPORTS[how]))
    of_torch = load_function(torchscript(tmp_path / "net.pt"))
    for light in (LIGHT, np.tile(LIGHT, (2, 3, 1))):  # 6 and 18 rows: not multiples of 4
        values = of_torch.evaluate(light, POSITIONS, LIGHT[:2])
        assert np.ptp(values) > 0.01
        np.testing.assert_allclose(of_onnx.evaluate(light, POSITIONS, LIGHT[:2]), values, rtol=0, atol=1e-6)


def test_their_baked_assets_agree(tmp_path: Path) -> None:
    files = export(tmp_path / "net.onnx", **EXPORTS["by tracing"]), torchscript(tmp_path / "net.pt")
    assets = [
        bake(load_function(file, box_min=[-1, -1, -1], box_side=2), icosphere(0), rings=1, sectors=2, samples=64)
        for file in files
    ]
    one, other = (np.asarray(asset.coefficients, np.float64) for asset in assets)
    assert np.abs(other).max() > 0.1
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("kind", "error"), [("FLOAT", 1e-7), ("DOUBLE", 1e-7), ("FLOAT16", 1e-3)])
def test_inputs_of_every_float_type(kind: str, error: float, tmp_path: Path) -> None:
    number = getattr(TensorProto, kind)
    path = write(tmp_path / "a.onnx", [("x", number, ["n", 7])], [("y", number, ["n", 3])])
    found = load_function(path, "position, incident, outgoing").evaluate(LIGHT, POSITIONS, LIGHT[:2])
    np.testing.assert_allclose(found, np.repeat(POSITIONS[:, None], 3, axis=1), atol=error)


def test_a_file_without_declared_shapes(tmp_path: Path) -> None:
    path = write(tmp_path / "a.onnx", [("x", FLOAT, None)], [("y", FLOAT, None)])
    assert load_function(path).evaluate(LIGHT, POSITIONS, LIGHT[:2]).shape == (2, 3, 3)


def test_the_output_of_three_numbers_is_found_among_others(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Slice", ["x", "begin", "five", "axis"], ["features"]),
        helper.make_node("Slice", ["x", "begin", "end", "axis"], ["y"]),
    ]
    features = ("features", FLOAT, ["n", 5])
    path = write(tmp_path / "a.onnx", [X], [features, Y], nodes, [("five", [5])])
    assert load_function(path).evaluate(LIGHT, POSITIONS, LIGHT[:2]).shape == (2, 3, 3)


@pytest.mark.parametrize("rows", ["n", 4])
def test_outputs_below_one_another_as_skl2onnx_writes_them(rows: Any, tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Slice", ["x", "begin", "end", "axis"], ["z"]),
        helper.make_node("Reshape", ["z", "flat"], ["y"]),
    ]
    inputs = [("x", FLOAT, [rows, 7])]
    path = write(tmp_path / "a.onnx", inputs, [("y", FLOAT, ["m", 1])], nodes, [("flat", [-1, 1])])
    found = load_function(path, "position, incident, outgoing").evaluate(LIGHT, POSITIONS, LIGHT[:2])
    np.testing.assert_allclose(found, np.repeat(POSITIONS[:, None], 3, axis=1), atol=1e-7)


def test_another_process_opens_the_file_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    transport = load_function(write(Path("a.onnx"), [X], [Y]).name, "outgoing, incident, position; angles=radians")
    sent = pickle.dumps(transport)
    monkeypatch.chdir("/")
    query = (LIGHT, POSITIONS, LIGHT[:2])
    np.testing.assert_array_equal(pickle.loads(sent).evaluate(*query), transport.evaluate(*query))


def test_functions_of_other_inputs_and_outputs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    nine, image = ("x", FLOAT, ["n", 9]), ("x", FLOAT, [1, 3, 8, 8])
    for inputs, sentence in (
        ([nine], r"a\.onnx: expected one input \[rows, 7\], found x \[n, 9\]"),
        ([("x", FLOAT, ["n", 4]), ("z", FLOAT, ["n", 3])], r"found x \[n, 4\], z \[n, 3\]"),
        ([image], r"found x \[1, 3, 8, 8\]"),
        ([("x", TensorProto.INT32, ["n", 7])], r"expected an input of float32, float64 or float16, found x of int32"),
    ):
        with pytest.raises(ModelError, match=sentence):
            load_function(write(path, inputs, [("y", inputs[0][1], None)]))
    with pytest.raises(ModelError, match=r"expected one output \[5, 3\] from \[5, 7\], found y \[5, 4\]$"):
        load_function(wide(path))
    with pytest.raises(ModelError, match=r"found y \[5, 3\], z \[5, 3\]; keep one by onnx.utils.extract_model"):
        load_function(twice(path))
    with pytest.raises(ModelError, match=r"a\.onnx: failed on \[5, 7\] of float32 \(.*MatMul"):
        load_function(of_hidden_nine(path))


def wide(path: Path) -> Path:
    nodes = [helper.make_node("Slice", ["x", "begin", "four", "axis"], ["y"])]
    return write(path, [X], [("y", FLOAT, None)], nodes, [("four", [4])])


def twice(path: Path) -> Path:
    nodes = [helper.make_node("Slice", ["x", "begin", "end", "axis"], [name]) for name in "yz"]
    return write(path, [X], [Y, ("z", FLOAT, ["n", 3])], nodes)


def of_hidden_nine(path: Path) -> Path:
    nodes = [
        helper.make_node("Constant", [], ["w"], value=helper.make_tensor("w", FLOAT, [9, 3], [1.0] * 27)),
        helper.make_node("MatMul", ["x", "w"], ["y"]),
    ]
    return write(path, [("x", FLOAT, None)], [("y", FLOAT, None)], nodes)


def test_damaged_files_and_those_of_newer_versions_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.onnx"
    whole = write(path, [X], [Y]).read_bytes()
    for content, sentence in (
        (whole[: len(whole) // 2], "not an ONNX file, or truncated"),
        (b"words", "not an ONNX file, or truncated"),
        (b"", "not an ONNX file, or truncated"),
    ):
        path.write_bytes(content)
        with pytest.raises(ModelError, match=rf"a\.onnx: {sentence}"):
            load_function(path)
    opsets = [helper.make_opsetid("", 99)]
    with pytest.raises(ModelError, match=r"its opset 99 is newer than onnxruntime \S+ supports; export it with an"):
        load_function(write(path, [X], [Y], opset_imports=opsets))
    with pytest.raises(ModelError, match=r"its IR version 99 is newer than onnxruntime"):
        load_function(write(path, [X], [Y], ir_version=99))
    with pytest.raises(ModelError, match=r"onnxruntime \S+ cannot run it \(.*Foo"):
        load_function(write(path, [X], [Y], [helper.make_node("Foo", ["x"], ["y"], domain="own")]))


def test_weights_in_a_file_of_their_own_must_be_beside_it(tmp_path: Path) -> None:
    path = export(tmp_path / "net.onnx", **EXPORTS["by dynamo"])
    path.with_name("net.onnx.data").unlink()
    with pytest.raises(ModelError, match=r"its weights are in net\.onnx\.data, which is not beside it; copy both"):
        load_function(path)


def test_without_onnxruntime_a_sentence_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.onnx", [X], [Y])
    monkeypatch.setattr("formats.extras.find_spec", lambda name: None)
    with pytest.raises(PrtbakeError, match=r"a\.onnx: onnxruntime is not installed; pip install onnxruntime"):
        load_function(path)
