"""Example environments with robots."""
