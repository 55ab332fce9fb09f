"""Placement of clients: nodes with the required resources, and the run's address for them."""
