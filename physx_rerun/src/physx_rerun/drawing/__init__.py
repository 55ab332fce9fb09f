"""Conversion of scene events to Rerun archetypes."""
