"""Default plugins."""

BACKEND = "dart"
"""Reference of the physics engine."""
VIEWER = "rerun"
"""Reference of the visualizer."""
