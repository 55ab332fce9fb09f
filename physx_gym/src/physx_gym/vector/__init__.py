"""Vector environments in worker processes."""
