import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.points.binning import Points, photo

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 0.5, 6, 5)
COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 0, 1)]
RIM = 3
clouds = st.lists(
    st.tuples(
        st.integers(-RIM, GRID.width + RIM - 1),
        st.integers(-RIM, GRID.height + RIM - 1),
        st.integers(0, 2),
        st.sampled_from(COLOURS),
    ),
    max_size=25,
)


def points(cloud) -> Points:
    col, row, z, colour = zip(*cloud, strict=True) if cloud else ([], [], [], np.empty((0, 3)))
    east, north = GRID.west + (np.array(col, float) + 0.5) / 2, GRID.north - (np.array(row, float) + 0.5) / 2
    return Points(east, north, np.array(z, float), np.zeros(len(z), np.uint8), np.array(colour, np.uint8))


@given(clouds, st.sampled_from([0, 1, 2, 3]))
def test_photo_matches_definition(cloud, pixels):
    tops = {}
    for col, row, z, colour in cloud:
        tops[row, col] = max(tops.get((row, col), (-1, ())), (z, colour))
    result = photo(points(cloud), GRID, pixels * GRID.cell)
    for row in range(GRID.height):
        for col in range(GRID.width):
            near = [((r - row) ** 2 + (c - col) ** 2, r, c) for r, c in tops]
            best = min(near, default=(np.inf, 0, 0))
            assert result.known[row, col] == (best[0] <= pixels**2)
            expected = tops[best[1:]][1] if result.known[row, col] else (0, 0, 0)
            assert tuple(result.colour[:, row, col]) == expected
