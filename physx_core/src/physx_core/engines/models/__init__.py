"""Robots and objects as engines load them: files, shapes, meshes."""
