"""Launchers: clients as Ray actors or as Slurm jobs."""
