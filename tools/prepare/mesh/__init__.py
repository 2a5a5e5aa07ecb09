"""Textured meshes (OBJ, PLY, glTF): read, georeference, sample to points."""
