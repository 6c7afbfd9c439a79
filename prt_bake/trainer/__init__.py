"""The reference path tracer, and the trainer that learns from it."""
