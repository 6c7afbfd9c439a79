"""Learning: losses, optimisers and the learner of a network's layers, and the fit of its low bands.

May import: `prt_bake.trainer.samples`, `prt_bake.network` and the rooms below. Begin with `learner.py`.
"""
