"""Heights of a run for road networks and features of other programs; one file per format.

Each format is a module with the functions ``frame``, the coordinate system that a file names, and ``lift``,
which copies a file with heights (`tools.lift.types`).
"""
