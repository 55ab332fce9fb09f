"""The plugins that are used unless others are named."""

BACKEND = "dart"
"""Reference of the physics engine."""
VIEWER = "rerun"
"""Reference of the visualizer."""
