"""Placement of clients: the nodes that have what each needs, and the run's address for them."""
