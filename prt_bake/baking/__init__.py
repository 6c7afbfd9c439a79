"""Baking: plan, pruning, sampling, checkpoints, output, compression.

Folders from bottom to top: `job` (checked arguments, provenance), `pruning` (which parts are redundant), `output`
(arrays, files, checkpoints), `adaptive` (bakes to a requested error), the files of this folder, `report` (methods
compared).
May import: `bakers`, `formats`, `prt_bake.network`, `.tracer`, `.reflection`, `.shading.reconstruction`, `.lights`,
`.geometry`, `.mathematics` and `.jit`. Begin with `bake.py`.
"""
