"""Difficult transports on small meshes, with the arguments of a bake of each."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import prt_bake
from bakers.transport import on_mesh, prepared, up_to
from formats.mesh import Mesh, build_mesh, read_mesh
from prt_bake.mathematics.random import uniforms
from prt_bake.network.bssrdf import load_model
from tests.bakers.transports import Array, Chequered, Edged, Lobed, icosphere

SHIPPED = Path(prt_bake.__file__).parent / "shipped"
Function = Callable[[Array, Array, Array], Array]
"""Cosines to the normal [N,D], positions [N,3] and directions to the eye [N,3] → values [N,D]."""


@dataclass(frozen=True)
class Analytic:
    """Ŝ as a function of the cosine to the normal, the position and the view, with scaled channels."""

    function: Function

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.einsum("ndi,ni->nd", incident, positions)
        return np.asarray(self.function(cosine, positions, outgoing)[..., None] * np.array([1.0, 0.7, 0.5]))


@dataclass(frozen=True)
class Case:
    """A bake and its reference; `stored`: it is written to a file in float16."""

    transport: Any
    subdivisions: int = 1
    rings: int = 4
    sectors: int = 16
    degree: int = 2
    directions: int = 4096
    stored: bool = False
    more: dict[str, Any] = field(default_factory=dict)
    mesh: Mesh | None = None
    reference: Any = None
    """Reference transport; None: the transport itself."""


def cases() -> dict[str, Case]:
    """All cases by name."""
    found = {name: Case(Analytic(of)) for name, of in _functions().items()}
    jump = Analytic(lambda c, x, o: np.where(c > 0.9, 1e4, 1.0))
    found["10⁴ : 1 over directions, a jump"] = Case(jump, 0, directions=1 << 17)
    few = Analytic(lambda c, x, o: np.where(c > 0.9998, np.nan, _clamped(c)))
    found["NaN in one direction of 10,000"] = Case(few, reference=Analytic(lambda c, x, o: _clamped(c)))
    for floor in (0.001, 0.01, 0.1):
        found[f"a lobe of 2 degrees over {floor:g}"] = Case(Lobed(3000.0, floor), 0, directions=1 << 16)
    found["a jump in the light"] = Case(Analytic(lambda c, x, o: 0.1 + (c > 0.3)), directions=1 << 15)
    found["a jump in the view"] = Case(Analytic(lambda c, x, o: _clamped(c) * (1.0 + (o[:, :1] > 0.2))), 1, 16, 64)
    found["chequered"] = Case(Chequered(), 0, 16, 64)
    found["one vertex"] = Case(Lobed(), rings=16, sectors=64, mesh=_one_vertex())
    for rings, sectors in ((1, 1), (1, 64), (64, 1), (16, 64)):
        found[f"bins {rings}×{sectors}"] = Case(Lobed(), rings=rings, sectors=sectors)
    for degree in (0, 8):
        found[f"degree {degree}"] = Case(Edged(), degree=degree, directions=1 << 14)
    for size in (1e39, 1e30, 1e6, 1e-6, 1e-10, 1e-30, 1e-42, 1e-50):
        found[f"values of {size:g}, stored"] = Case(Analytic(_sized(size)), stored=True)
    found["10⁹ at one vertex, stored"] = Case(
        Analytic(lambda c, x, o: _clamped(c) * 10.0 ** (9.0 * _top(x))), stored=True
    )
    network, spot = load_model(SHIPPED / "spot.pt"), _patch_of_spot()
    for precision in ("float32", "bfloat16"):
        reference = prepared(up_to(on_mesh(network, spot), 2), "float32", "cpu")
        more = {"precision": precision}
        found[f"spot, {precision}"] = Case(on_mesh(network, spot), mesh=spot, reference=_Rows(reference), more=more)
    return found


def _functions() -> dict[str, Function]:
    return {
        "constant": lambda c, x, o: np.full_like(c, 0.7),
        "zero": lambda c, x, o: np.zeros_like(c),
        "zero at half of the vertices": lambda c, x, o: _clamped(c) * (x[:, 2:] > 0.1),
        "zero from half of the views": lambda c, x, o: _clamped(c) * (o[:, 2:] > 0.0),
        "negative in places": lambda c, x, o: c**3 - 0.2,
        "negative": lambda c, x, o: -0.2 - _clamped(c),
        "of no mean": lambda c, x, o: c**3 + 0.3 * c,
        "in no harmonic up to degree 2, but for a hundredth": lambda c, x, o: 0.01 + 5.0 * c**3 - 3.0 * c,
        "10⁴ : 1 along the surface": lambda c, x, o: _clamped(c) * 10.0 ** (2.0 * x[:, 2:]),
        "10⁴ : 1 from vertex to vertex": lambda c, x, o: _clamped(c) * 10.0 ** (4.0 * _of_places(x)),
        "10⁴ : 1 over directions": lambda c, x, o: 10.0 ** (2.0 * c),
        "10⁴ : 1 over views": lambda c, x, o: _clamped(c) * 10.0 ** (4.0 * np.einsum("ni,ni->n", o, x)[:, None]),
        "NaN at one vertex": lambda c, x, o: np.where(_top(x), np.nan, _clamped(c)),
        "infinite from a view or two of half of them": lambda c, x, o: np.where(_seen_along(o), np.inf, _clamped(c)),
    }


def _clamped(cosine: Array) -> Array:
    return np.asarray(np.maximum(cosine, 0.0) + 0.05)


def _sized(size: float) -> Function:
    return lambda c, x, o: size * _clamped(c)


def _top(x: Array) -> Array:
    return np.asarray(np.isclose(x, icosphere(1).positions[17], atol=1e-6).all(axis=1)[:, None])


def _seen_along(o: Array) -> Array:
    return np.asarray(o @ np.array([0.48, 0.6, 0.64]) > 0.98)[:, None]


def _of_places(x: Array) -> Array:
    key = np.round(x * 1e6).astype(np.int64)
    return np.asarray(uniforms((2, key[:, 0], key[:, 1], key[:, 2]), 1))


def _one_vertex() -> Mesh:
    return Mesh(np.array([[0.0, 0.0, 1.0]]), np.zeros((0, 3), np.int32), np.array([[0.0, 0.0, 1.0]]))


def _patch_of_spot() -> Mesh:
    spot = read_mesh(SHIPPED / "spot.obj")
    used, faces = np.unique(spot.faces[:60], return_inverse=True)
    return build_mesh(spot.positions[used], faces.reshape(-1, 3))


@dataclass(frozen=True)
class _Rows:
    """A network with the interface of analytic transports; all rows use the same directions."""

    network: Any

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        rows = np.zeros((len(positions), 1), int)
        answer = self.network.evaluate_block(incident[:1], rows, positions, outgoing[:, None])
        return np.asarray(answer[:, 0], np.float64)
