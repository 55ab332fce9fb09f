"""Sockets, requests, and worlds that all protocols share."""
