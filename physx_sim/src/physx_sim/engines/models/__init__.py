"""Robots and objects as loaded by engines: files, shapes, meshes."""
