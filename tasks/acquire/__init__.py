"""Data acquisition, the paper's step A: DSM, DTM and DOP from points, meshes and photographs."""
