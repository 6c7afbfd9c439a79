"""Bakes a block of vertices to a given error by refinement over levels of view bins.

Each finer bin is interpolated from coarser ones. Where the prediction error is too large, Ŝ is integrated over a
rotated lattice of as many directions as the residual of its fit requires. Validation samples calibrate the stated
variances. On fine meshes, vertices are interpolated too. `prt_bake.baking.adaptive` chooses the tolerances, runs the
blocks of an object and writes its asset. May import the files at the top of `bakers`, and `formats`. Begin with
`refinement.py`.
"""

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import RefinedBlock, RefinementSettings, ValidationSamples
from bakers.adaptive.refinement import refine

__all__ = ["Correction", "RefinedBlock", "RefinementSettings", "Tally", "ValidationSamples", "refine"]
