"""A small scene and settings that train in seconds."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from formats.mesh import build_mesh, write_mesh
from formats.scene import Scene, read_scene
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from prt_bake.trainer.samples.rows import StreamSettings
from prt_bake.trainer.train import LearningSettings, train

SCENE = """
[object]
mesh = "ball.ply"
[interface]
eta = {eta}
roughness = {roughness}
[medium]
sigma_t = 4.0
albedo = [0.9, 0.7, 0.5]
"""
SMALL = NetworkSettings(
    features=32, feature_mean=0.0, feature_spread=0.15, width=32, layers=3, skips=((1, 3),), directions="cartesian"
)
STREAM = StreamSettings(queries_a_batch=512, walks=1, connections=4, exits=8, least_exits=2, kept=4, capacity=1 << 12)
LEARNING = LearningSettings(batch=128, rate=1e-2, spread=8, bfloat16=False, held_out_queries=128, held_out_walks=64)


def make_scene(folder: Path, eta: float = 1.0, roughness: float = 0.0) -> Scene:
    """An ellipsoid four mean free paths long."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    stretched = np.asarray(ball.vertices) * [1.0, 0.5, 2.0]
    write_mesh(build_mesh(stretched, np.asarray(ball.faces)), folder / "ball.ply")
    (folder / "scene.toml").write_text(SCENE.format(eta=eta, roughness=roughness))
    return read_scene(folder / "scene.toml")


def train_small(scene: Scene, steps: int, **arguments: Any) -> NeuralBSSRDF:
    """Train a small network for some steps."""
    defaults = {"settings": SMALL, "stream": STREAM, "learning": LEARNING, "seed": 1}
    return train(scene, steps=steps, **{**defaults, **arguments})
