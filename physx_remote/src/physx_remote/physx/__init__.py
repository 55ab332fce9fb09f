"""The authenticated protocol of physx: service and client."""
