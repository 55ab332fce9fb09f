"""Quantities, rewards, and terminations."""
