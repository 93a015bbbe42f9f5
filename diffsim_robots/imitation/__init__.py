"""Tasks that track a recorded motion."""
