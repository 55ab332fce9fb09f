"""Gymnasium environments as physx environments, and networks as policies."""
