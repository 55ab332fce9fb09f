"""The client side: one environment in a worker process."""
