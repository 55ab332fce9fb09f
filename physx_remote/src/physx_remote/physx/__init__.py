"""The authenticated protocol of physx."""
