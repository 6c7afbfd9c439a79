"""Learners and networks compared on the same path-traced rows: python -m tests.bench.same_rows SCENE.toml [VARIANT …].

Every variant takes the same steps on the same rows, each of which is used once, and then fits low bands to the queries
of the rows in several passes. Prints the error of a_lm over the
surface without the reference's noise, by band and by channel. Half a minute of paths in a clear object, ten minutes in
a dense one; then one to four minutes for each variant.
"""

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from formats.scene import Scene, read_scene
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF, load_model
from prt_bake.network.starting_weights import start_from
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.fit import settings_for
from prt_bake.trainer.interior import interior_of, with_fitting_grid
from prt_bake.trainer.learning.learner import Learner, LearningSettings, continued
from prt_bake.trainer.learning.low_bands import fit_low_bands
from prt_bake.trainer.samples.rows import Batch, ExitTracer, StreamSettings
from prt_bake.trainer.samples.traced import Traced
from prt_bake.trainer.training_data import box_of
from prt_bake.trainer.validation import HeldOutCoefficients, hold_out_coefficients, network_coefficients

Array = np.ndarray


@dataclass(frozen=True)
class Variant:
    """Settings that differ from the defaults."""

    learning: dict[str, Any] = field(default_factory=dict)
    network: dict[str, Any] = field(default_factory=dict)
    share: float = 1.0
    """Of the rows."""
    passes: int | None = None
    """Of the low bands; by default as many as in a training that has time."""


VARIANTS = {
    "default": Variant(),
    "AdamW alone": Variant({"muon": False}),
    "half of the rows": Variant(share=0.5),
    "all rays from the first step": Variant({"coarse_steps": 0}),
    "24 uniform directions": Variant({"spread": 24}),
    "24 uniform directions, all rays from the first step": Variant({"spread": 24, "coarse_steps": 0}),
    "without low bands": Variant(network={"low_width": 0}),
    "without low bands, all rays from the first step": Variant({"coarse_steps": 0}, {"low_width": 0}),
    "low bands without lobes": Variant(network={"low_axes": False}),
    "one pass of the low bands": Variant(passes=1),
    "four passes of the low bands": Variant(passes=4),
    "AdamW alone, all rays from the first step": Variant({"coarse_steps": 0, "muon": False}),
    "rate 0.008": Variant({"rate": 8e-3}),
    "weight decay 0.3": Variant({"decay": 0.3}),
    "batch 128": Variant({"batch": 128}),
    "batch 256": Variant({"batch": 256}),
    "batch 2048": Variant({"batch": 2048}),
    "without the material": Variant(network={"material_channels": 0}),
    "material along the whole ray alone": Variant(network={"material_parts": 0}),
    "grid of 64 nodes": Variant(network={"grid_places": 64}),
    "24 samples of the ray": Variant(network={"ray_samples": 24}),
    "8 places of the shape": Variant(network={"shape_places": 8}),
    "view rays of 16 bends": Variant(network={"interfaces": 16}),
    "view rays of 64 bends": Variant(network={"interfaces": 64}),
    "view rays of 256 bends": Variant(network={"interfaces": 256}),
    "view rays in one branch": Variant(network={"branches": 1}),
    "without the bodies inside": Variant(network={"inner_bodies": False}),
    "width 192": Variant(network={"width": 192}),
    "width 256": Variant(network={"width": 256}),
    "spread of G 2.4 (positions)": Variant(network={"position_spread": 2.4}),
}


def main() -> None:
    """Trace the rows and the reference, and print a line for each variant."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("variants", nargs="*", default=list(VARIANTS), help=f"of {', '.join(VARIANTS)}")
    parser.add_argument("--queries", type=int, default=614_400)
    parser.add_argument("--paths", type=int, default=32, help="per query")
    parser.add_argument("--rays", type=int, default=24, help="that represent the paths of a query")
    parser.add_argument("--start", type=Path, help="model that every network starts from, with the settings for that")
    parser.add_argument("--walks", type=int, default=8192, help="of each of the 1,000 queries of the reference")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scene = read_scene(arguments.scene)
    reference = hold_out_coefficients(scene, 1000, arguments.walks, 777, 512)
    rows, queries = traced_rows(scene, arguments.queries, StreamSettings(exits=arguments.paths, kept=arguments.rays))
    start = None if arguments.start is None else load_model(arguments.start)
    if start is not None and start.box_min.tolist() == box_of(scene).corner.tolist():
        print(f"{arguments.start}: {errors(start.on(scene.mesh), reference)}", flush=True)
    for name in arguments.variants:
        begun = time.perf_counter()
        network, steps = trained(scene, rows, queries, reference.scale(), VARIANTS[name], start)
        seconds = time.perf_counter() - begun
        print(f"{name:52s} {steps} steps, {seconds:4.0f} s, {errors(network, reference)}", flush=True)


def traced_rows(scene: Scene, count: int, settings: StreamSettings) -> tuple[Array, Traced]:
    """Rows of `count` queries, and the coefficients of all their walks."""
    tracer = ExitTracer(prepare(scene), box_of(scene), settings, 0)
    block = 4096
    blocks = [tracer.render(first, min(block, count - first)).rows for first in range(0, count, block)]
    queries = None if tracer.traced is None else tracer.traced.joined()
    assert queries is not None
    return np.concatenate(blocks), queries


def trained(
    scene: Scene, rows: Array, queries: Traced, scale: float, variant: Variant, start: Any = None
) -> tuple[NeuralBSSRDF, int]:
    """The network of a variant after one pass over its rows, and its steps."""
    box, settings = box_of(scene), replace(settings_for(PRESETS["measured"], scene), **variant.network)
    interior = interior_of(scene, box, with_meshes=True, with_material=settings.material_channels > 0)
    settings = replace(with_fitting_grid(settings, interior), **variant.network)
    network = NeuralBSSRDF(settings, box.corner, box.side, scale, {"normals": scene.normals}, interior)
    learning = LearningSettings(bfloat16=False)
    if start is not None:
        start_from(network, start)
        learning = continued(learning)
    learner = Learner(network.on(scene.mesh), replace(learning, **variant.learning))
    batch, generator = learner.settings.batch, np.random.default_rng(0)
    source: Any = _Rows()
    steps = int(variant.share * len(rows)) // batch
    for step in range(steps):
        some = rows[step * batch : (step + 1) * batch]
        learner.learn(source, Batch(some, np.arange(batch)), step / steps, generator)
    model: Any = learner.result()
    if model.low is not None:
        some = Traced._make(part[: steps * batch] for part in queries)
        passes = None if variant.passes is None else variant.passes * steps * batch // learning.low_batch
        fit_low_bands(model, some, learner.settings, 0, 0, steps=passes)
    return model.rounded(), steps


class _Rows:
    """All that a learner asks a source of rows."""

    exits = True

    def describe(self, number: int) -> str:
        return f"row {number}"


def errors(network: NeuralBSSRDF, reference: HeldOutCoefficients) -> str:
    """The relative RMSE of a_lm: of all, of bands 0, 1 and 2, and of the channels."""
    found = network_coefficients(network, reference.positions, reference.outgoing)
    noise = reference.standard_error**2
    off, whole = (found - reference.mean) ** 2 - noise, reference.mean**2 - noise

    def relative(part: Any) -> str:
        return f"{np.sqrt(max(0.0, off[part].sum()) / whole[part].sum()):.1%}"

    bands = ", ".join(relative(np.s_[:, first:last]) for first, last in ((0, 1), (1, 4), (4, 9)))
    channels = ", ".join(relative(np.s_[:, :, channel]) for channel in range(3))
    return f"a_lm {relative(np.s_[:])}; bands {bands}; channels {channels}"


if __name__ == "__main__":
    main()
