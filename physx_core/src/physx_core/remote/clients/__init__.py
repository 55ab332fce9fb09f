"""Clients: environments that run in another process, driven from here."""
