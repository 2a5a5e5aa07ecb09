"""``flexroad export``: a run in the formats of other programs.

For users of CAD, GIS, simulators and game engines. Start at `driver.export`, then `formats.FORMATS`: each
format has a row there, and a module that encodes its files.
"""
