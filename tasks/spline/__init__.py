"""The NURBS surface, its loss functions, and their solvers."""
