"""Layers that wrap an environment: observers, controllers, tasks."""
