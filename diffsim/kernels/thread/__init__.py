"""What one thread has: the specification, a scene's numbers, structs, lanes and blocks, spatial algebra."""
