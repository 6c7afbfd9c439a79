"""The command line, one module per command. `shared` holds common options, `reports` the commands that report.

May import: every room. Heavy libraries are imported inside the commands, so that `--help` is fast. Start at `main.py`.
"""
