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


def with_weights_in(path: Path, location: str) -> Path:
    """A file whose 21 weights, 84 bytes, are in another file."""
    weights = TensorProto(name="w", data_type=FLOAT, dims=[7, 3], data_location=TensorProto.EXTERNAL)
    for key, value in (("location", location), ("offset", "0"), ("length", "84")):
        weights.external_data.add(key=key, value=value)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"])],
        "weights elsewhere",
        *([helper.make_tensor_value_info(*each)] for each in (X, Y)),
        initializer=[weights],
    )
    path.write_bytes(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()
    )
    return path


def test_weights_in_another_file_must_be_whole_and_in_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    (folder / "sub").mkdir(parents=True)
    for place in (tmp_path, folder / "sub"):
        (place / "w.bin").write_bytes(np.ones(21, np.float32).tobytes())
    path = with_weights_in(folder / "a.onnx", "sub/w.bin")
    assert load_function(path).evaluate(LIGHT, POSITIONS, LIGHT[:2]).any()
    for location, sentence in (
        ("sub/none.bin", "its weights are in sub/none.bin, which is not beside it"),
        ("../w.bin", r"its weights are in \.\./w\.bin, outside its folder, from where none are read"),
        (str(tmp_path / "w.bin"), "w.bin, outside its folder"),
    ):
        with pytest.raises(ModelError, match=rf"a\.onnx: .*{sentence}"):
            load_function(with_weights_in(path, location))
    (folder / "sub" / "w.bin").write_bytes(bytes(40))
    with pytest.raises(ModelError, match=r"its weights in sub/w.bin do not fit it, or are truncated; copy both files"):
        load_function(with_weights_in(path, "sub/w.bin"))


@pytest.mark.parametrize("rows", [1, 7, 10000])
def test_a_fixed_number_of_rows_is_filled_up(rows: int, tmp_path: Path) -> None:
    path = write(tmp_path / "a.onnx", [("x", FLOAT, [rows, 7])], [("y", FLOAT, [rows, 3])])
    positions = np.random.default_rng(0).random((3000, 3))
    found = load_function(path, "position, incident, outgoing").evaluate(LIGHT, positions, np.resize(LIGHT, (3000, 3)))
    np.testing.assert_allclose(found, np.repeat(positions[:, None], 3, axis=1), atol=1e-6)


@pytest.mark.parametrize("rows", [0, 1 << 21, 1 << 40])
def test_an_absurd_number_of_rows_is_refused(rows: int, tmp_path: Path) -> None:
    path = write(tmp_path / "a.onnx", [("x", FLOAT, [rows, 7])], [("y", FLOAT, [rows, 3])])
    with pytest.raises(ModelError, match=rf"a\.onnx: expected 1 to 1048576 rows, found an input of {rows} rows"):
        load_function(path)


def test_values_that_depend_on_other_rows_or_on_chance_are_refused(tmp_path: Path) -> None:
    largest = [
        helper.make_node("Slice", ["x", "begin", "end", "axis"], ["z"]),
        helper.make_node("ReduceMax", ["z"], ["m"], axes=[0], keepdims=1),
        helper.make_node("Div", ["z", "m"], ["y"]),
    ]
    random = [
        helper.make_node("Slice", ["x", "begin", "end", "axis"], ["z"]),
        helper.make_node("RandomUniformLike", ["z"], ["r"], low=0.9, high=1.1),
        helper.make_node("Mul", ["z", "r"], ["y"]),
    ]
    for rows in ("n", 4):
        inputs, outputs = [("x", FLOAT, [rows, 7])], [("y", FLOAT, [rows, 3])]
        with pytest.raises(ModelError, match=r"a\.onnx: .* change with the other rows of a batch, .*\.eval\(\)"):
            load_function(write(tmp_path / "a.onnx", inputs, outputs, largest))
        with pytest.raises(ModelError, match=r"a\.onnx: .* they change from call to call, as with dropout"):
            load_function(write(tmp_path / "a.onnx", inputs, outputs, random))
    transposed = [
        helper.make_node("Transpose", ["x"], ["t"]),
        helper.make_node("Slice", ["t", "begin", "end", "axis"], ["y"]),
    ]
    with pytest.raises(ModelError, match="or with rows as columns"):
        load_function(write(tmp_path / "a.onnx", [("x", FLOAT, [7, "n"])], [("y", FLOAT, None)], transposed))


@pytest.mark.parametrize("exporting", [torch.onnx.TrainingMode.TRAINING, torch.onnx.TrainingMode.EVAL])
def test_batch_normalisation_must_be_exported_in_evaluation_mode(exporting: Any, tmp_path: Path) -> None:
    layers = torch.nn.Linear(7, 16), torch.nn.BatchNorm1d(16), torch.nn.ReLU(), torch.nn.Linear(16, 3)
    trained, path = torch.nn.Sequential(*layers).train(), tmp_path / "bn.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(trained, (torch.rand(4, 7),), str(path), verbose=False, training=exporting, dynamo=False)
    if exporting == torch.onnx.TrainingMode.EVAL:
        assert load_function(path).evaluate(LIGHT, POSITIONS, LIGHT[:2]).any()
    else:
        with pytest.raises(ModelError, match=r"bn\.onnx: expected values that depend on their own row"):
            load_function(path)


def test_without_onnxruntime_a_sentence_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.onnx", [X], [Y])
    monkeypatch.setattr("formats.extras.find_spec", lambda name: None)
    with pytest.raises(PrtbakeError, match=r"a\.onnx: onnxruntime is not installed; pip install onnxruntime"):
        load_function(path)
