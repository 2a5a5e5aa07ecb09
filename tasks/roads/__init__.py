"""Road masks: rasterise vectors, clean and compare masks, align orthophotos, find invalid DTM cells.

And the lines of OpenCRG and OpenDRIVE: routes, reference lines, heights and profiles along them.
"""
