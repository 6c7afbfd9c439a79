"""What other people's programs make of exported files: `make test-engines`, and for Blender `make test-blender`."""
