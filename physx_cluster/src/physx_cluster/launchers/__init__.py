"""Launchers: clients as actors of Ray, and as jobs of Slurm."""
