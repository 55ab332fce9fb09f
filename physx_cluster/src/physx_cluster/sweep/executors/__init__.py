"""Executors: run the processes of trials."""
