"""Processes that are forked after kernels were used: they compute alone, or say why not; none waits for ever."""

import subprocess
import sys

CHILD = """
import os
import numpy as np
def run(work):
    work()
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    try:
        work()
    except RuntimeError as error:
        print(error, flush=True)
        os._exit(3)
    os._exit(0)
"""
NETWORK = """
import prt_bake as prt
network = prt.NeuralBSSRDF()
draw = np.random.default_rng(0).normal(size=(8, 512, 3))
places = np.zeros((2, 64), int), np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 64, 1))
print(run(lambda: network.evaluate_block(draw, *places)))
"""
PATHS = """
import prt_bake as prt
from prt_bake.shipped.demonstration import SHIPPED
scene = prt.load_scene(SHIPPED / "spot.toml")
at = scene.mesh.positions[:4], scene.mesh.normals[:4], scene.mesh.normals[:4]
print(run(lambda: prt.estimate_transport(scene, *at, paths=16)))
"""
SHADING = """
from prt_bake.jit.threads import using_threads
def work():
    with using_threads(2):
        pass
print(run(work))
"""


def printed(work: str) -> list[str]:
    command = [sys.executable, "-c", CHILD + work]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout.splitlines()


def test_a_network_is_evaluated_in_a_forked_process() -> None:
    assert printed(NETWORK) == ["0"]


def test_shading_in_a_forked_process_is_refused() -> None:
    message, code = printed(SHADING)
    assert code == "3"
    assert "forked" in message


def test_paths_are_traced_in_a_forked_process() -> None:
    assert printed(PATHS) == ["0"]
