"""The paper's tables, made anew on scenes of our own: `prtbake report paper`."""
