"""The paper's figures for a mesh: vertical distance, mean angular deviation (MAD), triangles."""
