"""The identity of a transport, by which a resumed bake recognises the bake that it continues."""

import hashlib
from typing import Any

import numpy as np

from bakers.evaluation import values_at
from bakers.transport import transport_kind
from formats.mesh import Mesh
from prt_bake.mathematics import sphere

POSITIONS, DIRECTIONS = 4, 16


def identity_of(transport: Any, mesh: Mesh, provenance: dict[str, Any]) -> tuple[str, int]:
    """A hash that identifies the transport, and the number of evaluations that it took.

    Hashes the source file, a network's weights and interior, the scene of a path tracer (whose estimates are random),
    or the values of the transport at a few vertices.
    """
    if "source_sha256" in provenance:
        return str(provenance["source_sha256"]) + str(provenance.get("source_data_sha256", "")), 0
    digest = hashlib.sha256(type(transport).__name__.encode())
    network = getattr(transport, "network", transport)
    if hasattr(network, "state_dict"):
        for name, tensor in network.state_dict().items():
            digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
        view = getattr(network, "view", None)
        if view is not None:
            digest.update(view.interior.content_hash.encode())
        return digest.hexdigest(), 0
    if transport_kind(transport) == "coefficients":
        digest.update(str((getattr(transport, "metadata", None) or {}).get("scene_hash")).encode())
        return digest.hexdigest(), 0
    chosen = np.unique(np.linspace(0, len(mesh.positions) - 1, POSITIONS).astype(np.int64))
    lattice = sphere.fibonacci(DIRECTIONS)[None]
    rows = np.zeros(len(chosen), np.int64)
    values = values_at(transport, lattice, rows, mesh.positions[chosen], mesh.normals[chosen])
    digest.update(np.ascontiguousarray(values, np.float64).tobytes())
    return digest.hexdigest(), values.shape[0] * values.shape[1]
