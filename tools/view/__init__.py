"""``flexroad view``: a run as a page for browsers, with a map and the surface in 3D.

For who wants to look at a run. Start at `driver.write_viewer`; `encoding.py` has the bytes of a tile, and
``viewer/`` at the top the page's JavaScript.
"""
