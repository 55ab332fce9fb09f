"""Where clients run, and where they reach the run's server."""
