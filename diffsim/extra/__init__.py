"""Nothing in the core imports this: optional rooms, which the core knows by name and loads when they are asked for."""
