"""Robots: read an MJCF file into a scene, or refuse it with one clear message."""
