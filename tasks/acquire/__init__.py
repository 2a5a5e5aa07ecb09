"""Before there are rasters: the paper's step A, from points, meshes and photographs to DSM, DTM and DOP."""
