"""The robot as a tree: kinematics, inertias, articulated-body sweeps and solves with their factor."""
