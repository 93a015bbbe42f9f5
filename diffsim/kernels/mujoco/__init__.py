"""MuJoCo's constraints on the tree: contact with the ground, limits, dry friction, cones."""
