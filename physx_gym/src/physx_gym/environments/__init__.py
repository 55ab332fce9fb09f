"""Environments that are registered with Gymnasium as ``physx/<Name>-v0``."""
