"""The door: one small file a command, which declares, reads, calls one verb and writes."""
