"""Results in Python and as tables: `flexroad.fit`, `open_run`, `Surface`, and ``flexroad query``.

For users of heights and normals of the road. Start at `run.RunView` and `surface.fit`; the command calls
`query.at_points` and `query.along_lines`.
"""
