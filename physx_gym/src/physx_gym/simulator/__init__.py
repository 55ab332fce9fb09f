"""The simulated world of an environment with its motors and sensors."""
