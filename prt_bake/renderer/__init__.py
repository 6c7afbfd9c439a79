"""Pictures by Monte Carlo: what a pass sees, how directions are drawn, and the loop that adds passes up."""
