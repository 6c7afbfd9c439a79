"""Training: fits a network to the transport function of a scene, from path-traced random walks.

`samples` draws queries and path traces training rows; `report` measures a trained model. `report` may import this
folder's modules and `samples`, this folder's modules may import `samples`, and `samples` imports neither. May import
`prt_bake.rendering`, `prt_bake.comparison`, `prt_bake.network`, `prt_bake.tracer` and the rooms below.
Begin with `train.py`, then `learner.py`.
"""
