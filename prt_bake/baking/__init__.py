"""The verb `bake`: plan, pruning, sampling, checkpoints, output.

`adaptive` bakes to an error, `report` compares methods. May import: `bakers`, `prt_bake.network`, `prt_bake.tracer`,
`prt_bake.lights`, `prt_bake.reflection` and the rooms below. Begin with `bake.py`.
"""
