"""Checks that a physics engine does what physx and its users expect of one."""
