"""The command line: one module a command. `shared` holds what commands have in common, `reports` the reports.

May import: everything. Heavy imports happen inside the commands. Begin with `main.py`.
"""
