"""The pages of the documentation: their commands, links and names. `run.py` runs their commands."""
