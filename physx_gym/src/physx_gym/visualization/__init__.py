"""Rendering, plots, replays, and interactive play."""
