"""Before there are rasters: DSM, DTM and orthophoto from points, meshes and photographs (the paper's step A)."""
