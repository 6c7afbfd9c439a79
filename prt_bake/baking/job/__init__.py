"""What every bake needs before its first block: checked arguments, view bins, what is pruned, sampling and provenance.

`bake` makes a `Work` (`work.py`): transport, mesh, pruning, workers and callbacks, for every method. A bake with fixed
samples resolves it to a `Job` (`job.py`), whose `bakers.baker.Task` bakes blocks. An adaptive bake is a `Run`, which
holds the `Work` and an `AdaptiveJob` (both in `prt_bake.baking.adaptive`).
May import: `bakers`, `formats`, `prt_bake.mathematics`, `prt_bake.geometry` and `prt_bake.jit`. Begin with `work.py`.
"""
