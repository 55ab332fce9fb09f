"""Batched forward dynamics, in one process or several."""
