"""What every model of an object offers, and which kinds of models exist.

A model is a transport: bakes, pictures and reports need only `Model`. `TrainableModel` adds what the learner needs. The
neural BSSRDF is one kind; the baselines that it is compared with are others (`prt_bake.baselines`).
"""

import os
from abc import abstractmethod
from functools import partial
from importlib import import_module
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.errors import ModelError
from formats.mesh import Mesh
from prt_bake.network.lobes import Lobes

NEURAL_BSSRDF = "neural bssrdf"
_READERS = {"neumip": "prt_bake.baselines.neumip", "nerfactor": "prt_bake.baselines.nerfactor"}
"""Kind → the module whose `from_file(head, tensors)` makes a model of a file's content. By name: these rooms are above
this one."""

if hasattr(os, "register_at_fork"):  # Windows has no fork
    # torch waits for ever for its threads, which a forked process lacks.
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


class Model(nn.Module):
    """A model of Ŝ(ωi; x, ωo) [1/sr] of one object, as a torch module.

    Attributes:
        kind: the name of its kind, in files.
        settings: has `as_json()`, the settings by name.
        box_min, box_side: corner [3] and longest side of the object's bounding box, in scene units.
        output_scale: factor of the output [1/sr].
        metadata: plain JSON, stored in the file: scene, unit, training and its errors.
    """

    kind: ClassVar[str]
    settings: Any
    box_min: Tensor
    box_side: float
    output_scale: float
    metadata: dict[str, Any]

    @abstractmethod
    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] in 1/sr: incident [D,3] shared by all queries or [N,D,3], positions [N,3], outgoing [N,3]."""

    @abstractmethod
    def on(self, mesh: Mesh) -> Self:
        """The same model, weights shared, bound to the object's mesh."""

    @abstractmethod
    def refuse_foreign(self, mesh: Mesh) -> None:
        """Raise QueryError if the mesh is not the object that the model was made for."""

    @abstractmethod
    def file_content(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """The description of the model's file as plain JSON, with its kind as "kind", and its tensors on the processor.

        The description has the model's metadata as "metadata".
        """


class TrainableModel(Model):
    """A model that `prt_bake.trainer.learning.learner` fits."""

    @abstractmethod
    def encode_views(self, positions: Tensor, outgoing: Tensor) -> Any:
        """The part of the inputs of views [N,3] that does not depend on the weights; None if there is none."""

    @abstractmethod
    def components(
        self, incident: Tensor, positions: Tensor, outgoing: Tensor, encoding: Any = None
    ) -> tuple[Tensor, Lobes | None]:
        """Ŝ over the output scale: values [N,D,3] for incident [N,D,3], and lobes to add to them."""

    @abstractmethod
    def rounded(self) -> Self:
        """A copy whose weights are as a file stores them."""


def model_of_kind(kind: str, head: dict[str, Any], tensors: dict[str, Tensor]) -> Model:
    """The model of another kind than the neural BSSRDF, from the description and the tensors of its file.

    Raises ModelError for an unknown kind and for content that does not fit it.
    """
    if kind not in _READERS:
        known = ", ".join((NEURAL_BSSRDF, *_READERS))
        raise ModelError(
            f"a model of the kind {kind!r}; expected one of {known}; update prtbake, or train the model again"
        )
    model = import_module(_READERS[kind]).from_file(head, tensors)
    assert isinstance(model, Model)
    return model
