"""The verb `bake`: plan, pruning, sampling, checkpoints, output, compression.

Sub-rooms from bottom to top: `job` (checked arguments), `pruning` (what need not be baked), `output` (arrays, files,
checkpoints), `adaptive` (bakes to a requested error), the files of this folder, `report` (methods compared).
May import: `bakers`, `formats`, `prt_bake.network`, `.tracer`, `.reflection`, `.shading.reconstruction`, `.lights`,
`.geometry`, `.mathematics` and `.jit`. Begin with `bake.py`.
"""
