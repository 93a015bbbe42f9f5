"""Left and right alike: the mirror image of a task, and networks that treat it as the state itself."""
