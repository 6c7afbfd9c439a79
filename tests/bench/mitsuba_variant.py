"""Finds Mitsuba's CPU variants that work on this machine.

`llvm_ad_rgb` needs a libLLVM of the system. Some versions load and then abort the process on a real kernel, so each is
tried in a separate process.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

_FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")
_TRIAL = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
medium = {"type": "homogeneous", "sigma_t": 2.0, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
boundary = {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.2}
ball = {"type": "sphere", "boundary": boundary, "interior": medium}
world = mi.load_dict({"type": "scene", "integrator": {"type": "volpath", "max_depth": -1}, "ball": ball,
                      "light": {"type": "directional", "direction": [0, 0, -1]}})
sampler = mi.load_dict({"type": "independent"})
sampler.seed(1, 1024)
ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0, 0.1, 3), mi.Vector3f(0, 0, -1)))
seen, _, _ = world.integrator().sample(world, sampler, ray, None, True)
raise SystemExit(0 if 0 < max(seen.x) < 1e4 else 3)
"""


def working_variants() -> tuple[list[str], str]:
    """Set DRJIT_LIBLLVM_PATH if necessary, and return the variants and a description of the library."""
    tried = []
    for library in _libraries():
        environment = os.environ | ({"DRJIT_LIBLLVM_PATH": library} if library else {})
        trial = subprocess.run(
            [sys.executable, "-c", _TRIAL], env=environment, capture_output=True, timeout=120, check=False
        )
        if trial.returncode == 0:
            os.environ.update({"DRJIT_LIBLLVM_PATH": library} if library else {})
            return ["llvm_ad_rgb", "scalar_rgb"], f"libLLVM: {library or 'the one that Mitsuba finds'}"
        tried.append(library or "the one that Mitsuba finds")
    return ["scalar_rgb"], (
        f"no libLLVM works (tried {', '.join(tried)}), so the vectorised variant is missing: install Debian's "
        "libllvm19, or set DRJIT_LIBLLVM_PATH"
    )


def _libraries() -> list[str]:
    """The library in the environment, then the system's, newest first, then the one that Mitsuba finds."""
    found = {path.resolve() for folder in _FOLDERS for path in Path(folder).glob("**/libLLVM*.so*")}
    newest = sorted(found, key=lambda path: [-int(n) for n in re.findall(r"\d+", path.name)[:1]] or [0])
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    return [*([named] if named else []), *map(str, newest), ""]
