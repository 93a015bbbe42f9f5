"""A robot: from an MJCF file to a scene, or to one clear message."""
