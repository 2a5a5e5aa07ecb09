"""``flexroad prepare``: make rasters and their catalog from points, meshes and photographs."""
