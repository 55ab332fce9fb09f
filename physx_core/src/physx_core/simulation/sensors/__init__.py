"""Sensors of a robot, with their imperfections, the same on every engine.

A value out of range is a `ConfigError` as soon as a sensor is described.
"""
