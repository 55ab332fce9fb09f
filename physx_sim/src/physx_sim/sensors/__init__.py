"""Sensors of a robot, with their imperfections, independent of the engine.

An out-of-range value raises `ConfigError` when the sensor's description is created.
"""
