"""Sockets, requests and worlds, shared by all protocols."""
