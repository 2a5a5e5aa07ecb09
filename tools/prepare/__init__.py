"""``flexroad prepare``: rasters and their catalog from points, meshes and photographs.

For users without a DSM and DTM. Start at `from_points.py`, `from_mesh.py`, `from_photos.py` or `from_odm.py`:
each reads its input, and `raster_writer.py` writes the rasters.
"""
