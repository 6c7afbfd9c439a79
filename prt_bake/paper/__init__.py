"""`prtbake report paper`: the tables and figures of the paper, beside its own numbers.

May import: every room but `cli`, `preview` and `shipped`. Begin with `report.py`.
"""
