"""Contract checks for physics engines."""
