"""The scene: what an environment draws, as plain events for any viewer.

What cannot be drawn raises an error where it is added or changed, not in a viewer.
"""
