"""`prtbake report paper`: reproduces the tables and figures of the paper and compares them with its numbers.

`report.py` runs the scenes, `scene_report.py` one of them; `tables.py`, `sheet.py` and `plots.py` write the results.

May import: every room but `cli`, `preview` and `shipped`. Start at `report.py`.
"""
