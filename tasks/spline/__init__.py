"""The NURBS surface, its loss, and what minimises it."""
