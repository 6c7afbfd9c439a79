"""The demo's scene, model, sky and reference."""
