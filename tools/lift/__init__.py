"""``flexroad lift``: heights of a run for road networks and features of other programs.

For users of OpenDRIVE, SUMO, OSM and map features. Start at `driver.lift`. Each format is a module with the
functions ``frame``, the coordinate system that a file names, and ``lift``, which copies a file with heights
(`tools.lift.types`).
"""
