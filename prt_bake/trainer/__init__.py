"""Training: fits a network to the transport function of a scene, from path-traced random walks.

`samples` draws queries and path traces training rows; `report` measures a trained model. `report` may import this
folder's modules and `samples`, this folder's modules may import `samples`, and `samples` imports neither. May import
`prt_bake.comparison`, `prt_bake.rendering` and the rooms below these in `pyproject.toml`. Begin with `train.py`, then
`learner.py`.
"""
