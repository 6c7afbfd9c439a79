"""Training: a network learns the transport function of a scene from random walks.

`samples` makes the training rows, `report` measures a trained model. May import: `prt_bake.rendering`,
`prt_bake.comparison`, `prt_bake.network`, `prt_bake.tracer` and the rooms below. Begin with `train.py`.
"""
