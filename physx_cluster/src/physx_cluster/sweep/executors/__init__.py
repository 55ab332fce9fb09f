"""Executors: where the processes of trials run."""
