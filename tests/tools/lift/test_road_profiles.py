"""Cross-sections of a road at the limit of the survey."""

import numpy as np

from flexroad.tools.lift.road_profiles import cross_sections

NAN = np.nan


def test_a_single_place_with_ground_is_no_part_of_a_profile():
    on = np.array([100.0, 100.1, NAN, 100.3, NAN, NAN, 100.6, 100.7, NAN, 100.9])
    s, t = np.arange(10.0), np.array([-2.0, 0.0, 2.0])
    z = np.broadcast_to(on[:, None], (10, 3))
    found = cross_sections(s, t, z, (on, on, on), np.ones((10, 3), np.bool_), np.zeros(10, np.bool_))
    np.testing.assert_array_equal(found.line, [100.0, 100.1, NAN, NAN, NAN, NAN, 100.6, 100.7, NAN, NAN])
