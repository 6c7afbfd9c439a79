"""What a resumed bake must have been begun with: by what the transport is known again."""

import hashlib
from typing import Any

import numpy as np

from bakers.evaluation import values_at
from bakers.transport import way_in
from formats.mesh import Mesh
from prt_bake.mathematics import sphere

PLACES, DIRECTIONS = 4, 16


def identity_of(transport: Any, mesh: Mesh, provenance: dict[str, Any]) -> tuple[str, int]:
    """The hash of the source file, of a network's weights, or of what the transport answers at a few places; and the
    evaluations that it took. Of walks, which never answer the same, the hash of their scene.
    """
    if "source_sha256" in provenance:
        return str(provenance["source_sha256"]), 0
    digest = hashlib.sha256(type(transport).__name__.encode())
    network = getattr(transport, "network", transport)
    if hasattr(network, "state_dict"):
        for name, tensor in network.state_dict().items():
            digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
        return digest.hexdigest(), 0
    if way_in(transport) == "coefficients":
        digest.update(str((getattr(transport, "metadata", None) or {}).get("scene_hash")).encode())
        return digest.hexdigest(), 0
    some = np.unique(np.linspace(0, len(mesh.positions) - 1, PLACES).astype(np.int64))
    lattice = sphere.fibonacci(DIRECTIONS)[None]
    answers = values_at(transport, lattice, np.zeros(len(some), np.int64), mesh.positions[some], mesh.normals[some])
    digest.update(np.ascontiguousarray(answers, np.float64).tobytes())
    return digest.hexdigest(), answers.shape[0] * answers.shape[1]
