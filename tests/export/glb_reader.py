"""An independent reader of the GLB of an asset: JSON and struct, none of the product's code."""

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_KINDS = {5120: "i1", 5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


class Read(NamedTuple):
    """The document, the attributes of the first primitive, the engine form A [V,R,K,3], and extras.prtbake."""

    document: dict[str, Any]
    attributes: dict[str, np.ndarray]
    coefficients: np.ndarray
    extras: dict[str, Any]


def read_glb(path: Path) -> Read:
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    mesh = document["meshes"][0]
    attributes = {name: array(document, binary, index) for name, index in mesh["primitives"][0]["attributes"].items()}
    extras = mesh["extras"]["prtbake"]
    rows, columns = (extras["view_degree"] + 1) ** 2, (extras["light_degree"] + 1) ** 2
    name = extras["attributes"]
    stored = np.stack([[attributes[name.format(r=r, k=k)] for k in range(columns)] for r in range(rows)])  # [R,K,V,3]
    coefficients = stored.transpose(2, 0, 1, 3).astype(np.float64)
    if extras.get("quantize"):
        coefficients = np.maximum(coefficients / 127, -1) * np.array(extras["scales"])
    return Read(document, attributes, coefficients, extras)


def array(document: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    kind, columns = np.dtype(_KINDS[accessor["componentType"]]), _COUNTS[accessor["type"]]
    stride = view.get("byteStride", kind.itemsize * columns)
    rows = np.frombuffer(binary, np.uint8, accessor["count"] * stride, view["byteOffset"]).reshape(-1, stride)
    return np.ascontiguousarray(rows[:, : kind.itemsize * columns]).view(kind)


def radiance(read: Read, vertices: np.ndarray, outgoing: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Radiance [n,3], not clamped; harmonics from the formulas of the page on conventions, to degree 3."""
    x, y, z = outgoing.T
    one = np.ones(len(x))
    bands = [
        one, y, z, x, x * y, y * z, 3 * z**2 - 1, x * z, x**2 - y**2,
        y * (3 * x**2 - y**2), x * y * z, y * (5 * z**2 - 1), z * (5 * z**2 - 3), x * (5 * z**2 - 1),
        z * (x**2 - y**2), x * (x**2 - 3 * y**2),
    ]  # fmt: skip
    scale = [1 / 4, 3 / 4, 3 / 4, 3 / 4, 15 / 4, 15 / 4, 5 / 16, 15 / 4, 15 / 16]
    scale += [35 / 32, 105 / 4, 21 / 32, 7 / 16, 21 / 32, 105 / 16, 35 / 32]
    basis = np.stack([np.sqrt(s / np.pi) * band for s, band in zip(scale, bands, strict=True)], axis=1)
    rows = read.coefficients.shape[1]
    light = light if read.extras["quantity"] == "transfer" else np.ones((1, 3))
    return np.einsum("nr,nrkc,kc->nc", basis[:, :rows], read.coefficients[vertices], light)
