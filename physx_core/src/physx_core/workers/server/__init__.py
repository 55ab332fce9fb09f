"""The server side of a run with worker processes."""
