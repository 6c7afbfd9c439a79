"""Training: fits a network to the transport function of a scene, from path-traced random walks.

`samples` draws queries and path traces training rows, `learning` fits a network to them, `gpu` does both on a GPU, and
`report` measures a trained model. `report` may import this folder's modules, these may import the other folders, `gpu`
may import `learning` and `samples`, and `learning` may import `samples`. May import `prt_bake.comparison`,
`prt_bake.rendering` and the rooms below these in `pyproject.toml`. Begin with `train.py`, then `learning/learner.py`.
"""
