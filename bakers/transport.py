"""Protocols of transports: three interfaces through which a baker evaluates the transport function Ŝ(ωi; x, ωo) [1/sr].

Arguments are NumPy float64 arrays of unit vectors and object-space positions; results may be NumPy arrays or torch
tensors. Axes: N queries or vertices, B view bins, D incident directions, R copies of a direction set, C = 3 channels.
"""

from collections.abc import Sequence
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import numbers
from formats.errors import QueryError
from formats.mesh import Mesh, refuse_inside_out, refuse_two_sides

OUTSIDE = 0.01
"""How far a mesh may leave the model's box, in sides of the box."""

TransportKind = Literal["coefficients", "block", "evaluate"]


@runtime_checkable
class Transport(Protocol):
    """The reference interface."""

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike, /) -> Any:
        """Ŝ [N,D,3]: incident [D,3] shared by all queries or [N,D,3], positions [N,3], outgoing [N,3]."""


@runtime_checkable
class BlockTransport(Protocol):
    """A batched interface: many bins share few direction sets."""

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike, /
    ) -> Any:
        """Ŝ [N,B,D,3]: bin (n, b) at positions[n], seen along outgoing[n, b], for the directions incident[rotation[n,
        b]].
        """


class CoefficientEstimate(Protocol):
    """Estimated coefficients and one sigma of each, both [N,K,3]."""

    @property
    def mean(self) -> NDArray[np.float64]:
        """a_lm at each query."""

    @property
    def standard_error(self) -> NDArray[np.float64]:
        """One sigma of the mean."""


@runtime_checkable
class CoefficientTransport(Protocol):
    """An interface without Ŝ: random walks estimate the coefficients themselves."""

    def estimate_coefficients(
        self, positions: ArrayLike, outgoing: ArrayLike, degree: int, paths: int, seed: int, /
    ) -> CoefficientEstimate:
        """a_lm at positions [N,3] seen along outgoing [N,3], from `paths` walks per query, keyed by `seed`."""


@runtime_checkable
class WalkBlockTransport(Protocol):
    """`estimate_coefficients` for many vertices at once; offered in addition to it."""

    def estimate_block(
        self, positions: ArrayLike, outgoing: ArrayLike, degree: int, paths: int, seeds: Sequence[int], /
    ) -> Any:
        """`mean` and `standard_error` [n,B,K,3] at positions [n,3] seen along outgoing [n,B,3], and `statistics`
        (`bakers.path_traced.WalkStatistics`). Each vertex's numbers depend on its own seed of `seeds` [n].
        """


def transport_kind(transport: object) -> TransportKind:
    """The fastest interface that the object offers, found by its methods, not its type; raises QueryError if it has
    none.
    """
    if isinstance(transport, CoefficientTransport):
        return "coefficients"
    if isinstance(transport, BlockTransport):
        return "block"
    if isinstance(transport, Transport):
        return "evaluate"
    raise QueryError(
        f"{type(transport).__name__} cannot be baked: expected a method evaluate(incident, positions, outgoing), "
        f"evaluate_block or estimate_coefficients, or a function of (incident, positions, outgoing)"
    )


def on_mesh(transport: Any, mesh: Mesh) -> Any:
    """The transport bound to its object's mesh by its method `on`, if it has one; raises QueryError if that is None."""
    if not hasattr(transport, "on"):
        return transport
    bound = transport.on(mesh)
    if bound is None:
        raise QueryError(f"{label(transport)}.on: expected a transport, found None; end the method with `return self`")
    return bound


def up_to(transport: Any, degree: int) -> Any:
    """The transport limited by its method `up_to`, if it has one, to coefficients up to `degree`. It may then drop
    detail that is orthogonal to them and too narrow for few directions to resolve.
    """
    return transport.up_to(degree) if hasattr(transport, "up_to") else transport


def smooth(transport: Any, degree: int) -> Any:
    """The transport limited by its method `smooth`, if it has one: Ŝ in all bands, without what is too narrow for few
    directions to resolve, except for its bands up to `degree`.
    """
    return transport.smooth(degree) if hasattr(transport, "smooth") else transport


def transport_property(transport: Any, name: str, default: Any) -> Any:
    """A property of the transport, such as its index of refraction, from its metadata or its attributes."""
    metadata = getattr(transport, "metadata", None) or {}
    return metadata.get(name, getattr(transport, name, default))


def label(transport: Any) -> str:
    """What messages call a transport: its attribute `label`, such as its file, or its class."""
    return str(getattr(transport, "label", type(transport).__name__))


def refuse_foreign(transport: Any, mesh: Mesh) -> None:
    """Raises MeshError if the mesh is inside out, or has two sides and no normals (`formats.mesh`).

    Raises QueryError if the mesh is not the transport's own: if it leaves the box in which a network was trained, or
    if the transport's own method `refuse_foreign` refuses it. Outside its box a network's values are arbitrary.
    """
    refuse_two_sides(mesh)
    if hasattr(transport, "refuse_foreign"):
        transport.refuse_foreign(mesh)
    refuse_inside_out(mesh)
    if not hasattr(transport, "box_min") or not hasattr(transport, "box_side"):
        return
    corner = transport.box_min
    low = np.asarray(corner.cpu() if hasattr(corner, "cpu") else corner, np.float64)
    side = float(transport.box_side)
    beyond = np.maximum(low - mesh.positions, mesh.positions - low - side).max(axis=1)
    outside = np.flatnonzero(beyond > OUTSIDE * side)
    if len(outside):
        first = int(outside[0])
        raise QueryError(
            f"mesh: {len(outside)} of {len(mesh.positions)} vertices lie outside the box that the model was trained "
            f"in; the first is number {first}, {beyond[first]:.3g} away; bake the mesh of the model's own scene"
        )


def prepared(transport: Any, precision: str, device: str) -> Any:
    """The transport prepared for many evaluations, if it has a method `prepared`.

    Raises QueryError for a precision or device that the transport does not offer.
    """
    if hasattr(transport, "prepared"):
        return transport.prepared(precision=precision, device=device)
    if precision != "float32" or device not in ("cpu", getattr(transport, "device", "cpu")):
        raise QueryError(
            f"{label(transport)} can only be baked with precision float32 on the cpu, "
            f"found {precision} on {device}; those are for networks"
        )
    return transport


def as_radiance(result: Any, expected: tuple[int, ...], method: str) -> NDArray[Any]:
    """A transport's result, of any array library, as a NumPy array.

    Raises QueryError if it does not hold real numbers, or not in the expected shape.
    """
    radiance = numbers(f"the transport's {method}", result)
    if radiance.shape != expected:
        raise QueryError(
            f"the transport's {method} returned {radiance.dtype} of shape {radiance.shape}, "
            f"expected real numbers of shape {expected}"
        )
    return radiance
