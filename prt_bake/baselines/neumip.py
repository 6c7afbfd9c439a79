"""NeuMIP in the texture space of one object: a texture of features and a small decoder give Ŝ(ωi; x, ωo) [1/sr].

Kuznetsov, Mullia, Xu, Hašan and Ramamoorthi 2021, "NeuMIP: Multi-resolution neural materials", ACM TOG 40(4). A query
reads 7 features at its texture coordinates by bilinear interpolation. A decoder of three layers of 25 takes them with
the directions. As in the paper that compares itself with it, the offset module is left out. What else deviates is in
`docs/explanation/baselines.md`.
"""

from collections.abc import Sequence
from copy import copy, deepcopy
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.errors import ModelError, QueryError
from formats.mesh import Mesh, as_mesh
from prt_bake.baselines.neumip_settings import NeuMIPSettings
from prt_bake.baselines.texture_space import TextureSpace, numbered_corners, uv_areas
from prt_bake.geometry.surface import Location, Surface
from prt_bake.network.checkpoint import check_tensors
from prt_bake.network.initial_weights import initialise
from prt_bake.network.lobes import Lobes
from prt_bake.network.model import TrainableModel
from prt_bake.network.queries import queries

_ROWS_PER_BATCH = 1 << 16
_MAX_FLOAT16 = float(torch.finfo(torch.float16).max)
_OBJECT = ("positions", "faces", "normals", "corner_uv")
"""Tensors of the file that hold the object."""
_COPIES = "copies"


class TextureView(NamedTuple):
    """What views [N] read, whatever the weights are: rows [N,4L] of the table, their weights [N,4L], and the tangent
    frame [N,3,3], whose rows are tangent, bitangent and normal.
    """

    rows: Tensor
    weights: Tensor
    frame: Tensor


class NeuMIP(TrainableModel):
    """Ŝ as a neural texture: a transport for `prt.bake`, and the module that `train_neumip` fits."""

    kind = "neumip"

    def __init__(
        self,
        settings: NeuMIPSettings,
        mesh: Mesh,
        spaces: Sequence[TextureSpace],
        output_scale: float = 1.0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """A freshly initialised model of the object `mesh`, with the texture space of each level; metadata is JSON."""
        super().__init__()
        self.settings: NeuMIPSettings = settings
        self.output_scale, self.metadata = float(output_scale), dict(metadata or {})
        low, high = mesh.bounds
        self.box_side = float((high - low).max())
        self.register_buffer("box_min", torch.from_numpy(low.copy()), persistent=False)
        self.surface, self.spaces = Surface(mesh), tuple(spaces)
        self._tangents = _tangents(mesh, self.spaces[0].corner_uv)
        self._starts = np.cumsum([0, *(space.rows for space in self.spaces)])
        generator = torch.Generator().manual_seed(settings.seed)
        table = torch.randn(int(self._starts[-1]), settings.channels, generator=generator)
        self.table = nn.Parameter(settings.spread * table)
        """The features of all levels [rows, channels], finest first."""
        self.decoder = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in settings.layer_shapes)
        for number, layer in enumerate(self.decoder, start=1):
            initialise(layer, 1.0 if number == len(self.decoder) else 2.0, generator)

    def encode_views(self, positions: Tensor, outgoing: Tensor) -> TextureView:
        """What views [N,3] read. Raises QueryError for positions off the surface."""
        x, eye = (tensor.detach().double().cpu().numpy() for tensor in (positions, outgoing))
        threads = torch.get_num_threads()
        location, _cosines = self.surface.choose(x, eye)
        # Numba and torch share OpenMP's number of threads, which numba has now set to all cores.
        torch.set_num_threads(threads)
        taps = [space.taps(location.faces, location.barycentric) for space in self.spaces]
        rows = np.concatenate([tap.rows + start for tap, start in zip(taps, self._starts[:-1], strict=True)], axis=1)
        weights = np.concatenate([tap.weights for tap in taps], axis=1).astype(np.float32)
        frame = self._frames(location).astype(np.float32)
        device = self.table.device
        return TextureView(*(torch.from_numpy(array).to(device) for array in (rows, weights, frame)))

    def _frames(self, location: Location) -> NDArray[np.float64]:
        """Orthonormal frames [N,3,3] of tangent, bitangent and normal; the tangent is the direction of u."""
        u, v = location.barycentric[:, :1], location.barycentric[:, 1:]
        normal, tangent = (
            (1.0 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
            for corners in (self.surface.mesh.corner_normals[location.faces], self._tangents[location.faces])
        )
        normal = _unit(normal, np.asarray(self.surface.mesh.face_normals)[location.faces])
        tangent = _unit(tangent - np.sum(tangent * normal, axis=1, keepdims=True) * normal, _any_tangent(normal))
        return np.stack([tangent, np.cross(normal, tangent), normal], axis=1)

    def components(
        self, incident: Tensor, positions: Tensor, outgoing: Tensor, encoding: TextureView | None = None
    ) -> tuple[Tensor, Lobes | None]:
        """Ŝ over the output scale, values [N,D,3] for incident [N,D,3]; there are no lobes."""
        view = self.encode_views(positions, outgoing) if encoding is None else encoding
        features = nn.functional.embedding(view.rows, self.table, sparse=True)
        features = (features * view.weights[..., None]).sum(dim=1)
        eye = torch.einsum("nij,nj->ni", view.frame, outgoing.float())
        light = torch.einsum("nij,ndj->ndi", view.frame, incident.float())
        first, *others = self.decoder
        assert isinstance(first, nn.Linear)
        of_view, of_light = first.weight[:, :-3], first.weight[:, -3:]
        h = (torch.cat((features, eye), dim=1) @ of_view.T + first.bias)[:, None] + light @ of_light.T
        for layer in others:
            h = layer(torch.relu(h))
        return h, None

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] in 1/sr, float32: incident [D,3] shared by all queries or [N,D,3], positions [N,3], outgoing [N,3].

        Raises QueryError for other shapes, directions that are not unit vectors and positions off the surface.
        """
        light, x, eye = queries(incident, positions, outgoing, self.table.device)
        count, directions = len(x), light.shape[-2]
        light = light.expand(count, directions, 3)
        result = np.empty((count, directions, 3), np.float32)
        at_once = max(1, _ROWS_PER_BATCH // max(1, directions))
        with torch.inference_mode():
            for n in range(0, count, at_once):
                rows = slice(n, n + at_once)
                values, _none = self.components(light[rows], x[rows], eye[rows])
                result[rows] = (self.output_scale * values).cpu().numpy()
        return result

    def on(self, mesh: Mesh) -> Self:
        """Itself: the model knows its object's mesh."""
        as_mesh("mesh", mesh)
        return self

    def refuse_foreign(self, mesh: Mesh) -> None:
        """Raise QueryError if a vertex of the mesh is off the surface of the model's object."""
        faces = self.surface.find_faces(mesh.positions, mesh.normals)[0]
        if off := np.flatnonzero(faces < 0).tolist():
            raise QueryError(
                f"mesh: expected the surface of the model's object, found {len(off)} of {len(faces)} vertices off it; "
                f"the first, number {off[0]}, is {self.surface.distance(mesh.positions[off[0]]):.3g} away; bake the "
                "mesh of the model's own scene, or train a model on this mesh"
            )

    def rounded(self) -> Self:
        """A copy whose weights and features are float16 numbers."""
        copied = deepcopy(self)
        with torch.no_grad():
            for weight in copied.parameters():
                weight.copy_(torch.where(weight.abs() <= _MAX_FLOAT16, weight.half().float(), weight))
        return copied

    def file_content(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """The description and the tensors of the model's file: weights, features, the object and its texture space."""
        head = {
            "kind": self.kind,
            "settings": self.settings.as_json(),
            "output_scale": self.output_scale,
            "metadata": self.metadata,
        }
        mesh = self.surface.mesh
        arrays: list[NDArray[Any]] = [mesh.positions, mesh.faces, mesh.normals, self.spaces[0].corner_uv]
        tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in self.state_dict().items()}
        tensors |= {name: _stored(array) for name, array in zip(_OBJECT, arrays, strict=True)}
        for level, space in enumerate(self.spaces):
            tensors[f"{_COPIES}.{level}"] = _stored(np.stack([space.copies, space.copy_rows]))
        return head, tensors

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A copy with weights of its own and the same object."""
        copied = copy(self)
        copied._parameters, copied._modules = deepcopy(self._parameters, memo), deepcopy(self._modules, memo)
        copied.metadata = deepcopy(self.metadata, memo)
        return copied


def from_file(head: dict[str, Any], tensors: dict[str, Tensor]) -> NeuMIP:
    """The model of a file's description and tensors; raises ModelError for content that does not fit."""
    settings = NeuMIPSettings.from_json(head["settings"])
    positions, faces, normals, corner_uv = (_array(tensors, name) for name in _OBJECT)
    spaces = []
    for level, size in enumerate(settings.sizes):
        copies = _array(tensors, f"{_COPIES}.{level}").astype(np.int64)
        spaces.append(TextureSpace(size, corner_uv, copies[0], copies[1]))
    mesh = Mesh(positions, faces.astype(np.int64), normals)
    stored = tensors.get("table")
    rows = sum(space.rows for space in spaces)
    if stored is None or stored.shape != (rows, settings.channels) or corner_uv.shape != (len(mesh.faces), 3, 2):
        raise ModelError(
            f"expected a table of {rows} x {settings.channels} features and coordinates of {len(mesh.faces)} faces, "
            f"found shapes {None if stored is None else list(stored.shape)} and {list(corner_uv.shape)}; "
            "copy the file again, or train the model again"
        )
    model = NeuMIP(settings, mesh, spaces, float(head["output_scale"]), head["metadata"])
    check_tensors(tensors, {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}, "the model")
    model.load_state_dict(tensors)
    return model


def _stored(array: NDArray[Any]) -> Tensor:
    """Numbers for a file, exact: in float32 if that holds them, else in float64."""
    double = torch.from_numpy(np.array(array, np.float64))
    return double.float() if bool((double.float().double() == double).all()) else double


def _array(tensors: dict[str, Tensor], name: str) -> NDArray[np.float64]:
    if name not in tensors:
        raise ModelError(f"tensor {name} is missing; copy the file again, or train the model again")
    return tensors.pop(name).double().numpy()


def _tangents(mesh: Mesh, corner_uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """The direction of u at the corners of each face [F,3,3], the mean over the faces of a chart that meet there."""
    faces = np.asarray(mesh.faces, np.int64)
    corners = mesh.positions[faces]
    edges, steps = corners[:, 1:] - corners[:, :1], corner_uv[:, 1:] - corner_uv[:, :1]
    along = steps[:, 1, 1:] * edges[:, 0] - steps[:, 0, 1:] * edges[:, 1]
    along = _unit(along * np.sign(uv_areas(corner_uv))[:, None], np.zeros_like(along))
    numbers = numbered_corners(corner_uv, faces)
    sums = np.zeros((int(numbers.max()) + 1, 3))
    np.add.at(sums, numbers, (mesh.face_areas[:, None] * along)[:, None])
    return sums[numbers]


def _any_tangent(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    other = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    return np.asarray(other / np.linalg.norm(other, axis=1, keepdims=True))


def _unit(vectors: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """The vectors [N,3] at length 1; those of `otherwise` where they are nearly 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), otherwise)
