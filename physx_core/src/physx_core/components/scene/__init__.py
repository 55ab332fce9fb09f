"""The scene: what an environment draws, as plain events that travel to any viewer.

What cannot be drawn is an error where it is given, not in a viewer.
"""
