"""Radiance at the vertices of an asset in real time, frame by frame, at memory bandwidth.

`batches` selects vertices, `kernels` draws them, `holding` draws a fixed view, `codes` lays out compact assets. May
import: `prt_bake.shading`, `prt_bake.lights`, `prt_bake.jit` and `formats`. Begin with `frames.py`. This file imports
nothing, so that `codes` loads without the kernels.
"""
