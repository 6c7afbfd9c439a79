"""Processes that are forked after kernels were used: they compute alone, or say why not; none waits for ever."""

import subprocess
import sys

import pytest

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
print(run(lambda: network.evaluate_block(draw, *places)), flush=True)
"""
PATHS = """
import prt_bake as prt
from prt_bake.shipped.demonstration import SHIPPED
scene = prt.load_scene(SHIPPED / "spot.toml")
at = scene.mesh.positions[:4], scene.mesh.normals[:4], scene.mesh.normals[:4]
print(run(lambda: prt.estimate_transport(scene, *at, paths=16)), flush=True)
"""
SHADING = """
from prt_bake.jit.threads import using_threads
def work():
    with using_threads(2):
        pass
print(run(work), flush=True)
"""


def printed(work: str) -> list[str]:
    command = [sys.executable, "-c", CHILD + work]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout.splitlines()


@pytest.mark.usefixtures("compiled_kernels")
def test_networks_and_paths_are_computed_in_a_forked_process_and_shading_is_refused() -> None:
    of_network, of_paths, message, of_shading = printed(NETWORK + PATHS + SHADING)
    assert (of_network, of_paths, of_shading) == ("0", "0", "3")
    assert "forked" in message
