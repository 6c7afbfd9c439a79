"""The record of a baked asset; what each field becomes in a file is told in `formats.asset`."""

from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from formats.asset.error_covariance import ErrorShape
from formats.mesh import Mesh

Storage = Literal["float16", "float32"]

FOLDED_IN = "cosines, Fresnel transmission, visibility and scattering, self-shadowing included"


@dataclass(frozen=True, kw_only=True)
class AssetHead:
    """What is known of an asset before its first vertex is baked.

    Attributes:
        mesh: the baked mesh; a file keeps its positions as float32 about the centre of the bounding box.
        tangents: [V,3], unit, perpendicular to the vertex normals: where φ of the view bins is 0.
        rings: number of view bins over cosθ.
        sectors: number of view bins over φ.
        directions: [B,3], the bins' centres in the local frame (tangent, normal × tangent, normal).
        degree: of the spherical harmonics.
        check_directions: [2,3], two unit directions.
        check_values: [2,K], the basis at these directions.
        up: the scene's axis that points up, "y" or "z".
        handedness: "right", always.
        unit: the scene's unit of length.
        quantity: "transfer", or "radiance" for an asset made for one light (K = 1).
        folded_in: what the coefficients contain, in words; for "radiance" the hash of the light.
        left_out: what was left out to save time or space, each a dictionary of item, reason and saving.
    """

    mesh: Mesh
    tangents: NDArray[np.floating]
    rings: int
    sectors: int
    directions: NDArray[np.floating]
    degree: int
    check_directions: NDArray[np.floating]
    check_values: NDArray[np.floating]
    up: str = "y"
    handedness: str = "right"
    unit: str = "unit"
    quantity: str = "transfer"
    folded_in: str = FOLDED_IN
    left_out: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Asset(AssetHead):
    """A baked asset, in memory or on disk.

    Attributes:
        coefficients: float16 or float32 [V,B,K,C], an array or the open dataset of a file, B and C may be 1, see above;
            or `CompactCoefficients`, decoded where they are cut.
        standard_error: [V,B] (or [V,1]), one sigma of the coefficients, root mean square over K and C.
        valid: bool [V], false where a vertex was not baked.
        complete: false for a bake that was stopped before its end.
        provenance: command, resolved settings, seed, hashes of model and mesh, device, credits.
        error_vs_time: float64 [rows,3]: seconds, evaluations, estimated relative error.
        selftest: light [K,3], vertex [S], outgoing [S,3] and radiance [S,3] to be reproduced by importers, or nothing.
        storage: the type that a file of it keeps, "float16" or "float32".
        error_shape: how the errors of each vertex hang together, where that is known.
    """

    coefficients: Any
    standard_error: NDArray[np.float32]
    valid: NDArray[np.bool_]
    complete: bool = True
    provenance: dict[str, Any] = field(default_factory=dict)
    error_vs_time: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    selftest: dict[str, NDArray[Any]] = field(default_factory=dict)
    storage: Storage = "float16"
    error_shape: ErrorShape | None = None

    @property
    def eta(self) -> float:
        """The absolute index of refraction inside, as the provenance has it; 1 where it says nothing."""
        return float(self.provenance.get("eta", 1.0))

    @property
    def roughness(self) -> float | None:
        """The GGX alpha of the surface, the mean of a texture, as the provenance has it; None where it says nothing."""
        said = self.provenance.get("roughness", self.provenance.get("model", {}).get("roughness"))
        return None if said is None else float(said)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file behind the coefficients, if they are an open dataset; harmless otherwise."""
        if hasattr(self.coefficients, "file"):
            self.coefficients.file.close()
