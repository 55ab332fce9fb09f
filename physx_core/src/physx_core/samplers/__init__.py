"""The core's own samplers of parameters."""
