"""The core's samplers of parameters."""
