"""``flexroad lift``: heights of a run for road networks and features of other programs.

For users of OpenDRIVE, SUMO, OSM and map features. Start at `driver.lift`. Each format is a module with two
functions: ``frame`` returns the coordinate system that a file names, ``lift`` copies a file with heights.
"""
