"""``flexroad view``: a run as a page for browsers, with a map and the surface in 3D.

For users who look at a run. Start at `driver.write_viewer`. `encoding.py` writes the bytes of a tile. The
page's JavaScript is in ``viewer/``.
"""
