"""Forces on joints, links and contact spheres, a law per file with its adjoint."""
