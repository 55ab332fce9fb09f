"""The wire protocols that physx brings, one module each."""
