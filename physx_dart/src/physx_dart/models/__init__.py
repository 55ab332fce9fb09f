"""Robots and objects as the engines load them: files, shapes, meshes."""
