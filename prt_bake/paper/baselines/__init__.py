"""`prtbake report paper --baselines`: the paper's second table, the network beside NeuMIP and NeRFactor.

Begin with `report.py`, which measures scenes under skies. `contenders.py` lists the rows, `table.py` writes them.
"""
