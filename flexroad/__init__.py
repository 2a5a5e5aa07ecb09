"""Smooth, light, georeferenced 3D road surfaces from aerial geodata."""
