"""Plan geometry of OpenDRIVE against numeric integration."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest

from flexroad.tasks.errors import TaskError
from flexroad.tools.lift import plan_view

LENGTH = 80.0


def road(shape: str, s: float = 0.0, length: float = LENGTH) -> ET.Element:
    geometry = f'<geometry s="{s}" x="100" y="-50" hdg="2.1" length="{length}">{shape}</geometry>'
    return ET.fromstring(f"<road><planView>{geometry}</planView></road>")


def integrated(curvature, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y and heading at the end of each of some distances, by many short chords."""
    ends = []
    for end in s:
        along = np.linspace(0, end, 40_001)
        turn = 2.1 + np.concatenate(
            [[0.0], np.cumsum((curvature(along[1:]) + curvature(along[:-1])) / 2 * np.diff(along))]
        )
        middle = (turn[1:] + turn[:-1]) / 2
        ends.append(
            [
                100 + np.sum(np.cos(middle) * np.diff(along)),
                -50 + np.sum(np.sin(middle) * np.diff(along)),
                turn[-1],
            ]
        )
    x, y, heading = np.array(ends).T
    return x, y, heading


@pytest.mark.parametrize(
    ("shape", "first", "last"),
    [
        ("<line/>", 0.0, 0.0),
        ('<arc curvature="0.04"/>', 0.04, 0.04),
        ('<arc curvature="-0.11"/>', -0.11, -0.11),
        ('<spiral curvStart="0" curvEnd="0.05"/>', 0.0, 0.05),
        ('<spiral curvStart="-0.03" curvEnd="0"/>', -0.03, 0.0),
        ('<spiral curvStart="0.04" curvEnd="-0.06"/>', 0.04, -0.06),
        ('<spiral curvStart="0.05" curvEnd="0.02"/>', 0.05, 0.02),
        ('<spiral curvStart="-0.02" curvEnd="-0.05"/>', -0.02, -0.05),
        ('<spiral curvStart="0.02" curvEnd="0.0200000001"/>', 0.02, 0.0200000001),
        ('<spiral curvStart="0.02" curvEnd="0.02"/>', 0.02, 0.02),
    ],
)
def test_lines_arcs_and_spirals_are_the_integral_of_their_curvature(shape, first, last):
    s = np.linspace(0, LENGTH, 6)
    found = plan_view.read(road(shape)).at(s)
    expected = integrated(lambda along: first + (last - first) * along / LENGTH, s)
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, other, atol=1e-6)


def test_a_poly3_is_measured_along_its_curve():
    a, b, c, d = 0.5, 0.3, -0.01, 0.0004
    s = np.linspace(0, LENGTH, 9)
    x, y, heading = plan_view.read(road(f'<poly3 a="{a}" b="{b}" c="{c}" d="{d}"/>')).at(s)
    u = np.linspace(0, LENGTH, 400_001)
    v = a + b * u + c * u**2 + d * u**3
    long = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(u), np.diff(v)))])
    at_u, at_v = np.interp(s, long, u), np.interp(s, long, v)
    np.testing.assert_allclose(x, 100 + at_u * np.cos(2.1) - at_v * np.sin(2.1), atol=1e-6)
    np.testing.assert_allclose(y, -50 + at_u * np.sin(2.1) + at_v * np.cos(2.1), atol=1e-6)
    np.testing.assert_allclose(heading, 2.1 + np.arctan(b + 2 * c * at_u + 3 * d * at_u**2), atol=1e-6)


@pytest.mark.parametrize("p_range", ['pRange="arcLength"', 'pRange="normalized"', ""])
def test_a_param_poly3_is_measured_along_its_curve_and_ends_with_its_parameter(p_range):
    # One curve in all cases.
    long = 1.0 if "arc" in p_range else LENGTH
    u = np.array([0.2, 1.0 * long, -0.001 * long**2, 0.00001 * long**3])
    v = np.array([-0.1, 0.01 * long, 0.004 * long**2, -0.00002 * long**3])
    names = ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV")
    values = " ".join(
        f'{name}="{value!r}"' for name, value in zip(names, [*u.tolist(), *v.tolist()], strict=True)
    )
    s = np.array([0.0, 13.0, LENGTH])
    x, y, heading = plan_view.read(road(f"<paramPoly3 {values} {p_range}/>")).at(s)
    many = np.linspace(0, LENGTH / long, 400_001)
    curve = np.hypot(np.diff(np.polyval(u[::-1], many)), np.diff(np.polyval(v[::-1], many)))
    long_to = np.concatenate([[0.0], np.cumsum(curve)])
    p = np.interp(s / LENGTH, long_to / long_to[-1], many)
    at_u, at_v = np.polyval(u[::-1], p), np.polyval(v[::-1], p)
    np.testing.assert_allclose(x, 100 + at_u * np.cos(2.1) - at_v * np.sin(2.1), atol=1e-6)
    np.testing.assert_allclose(y, -50 + at_u * np.sin(2.1) + at_v * np.cos(2.1), atol=1e-6)
    step = 1e-6
    ahead = plan_view.read(road(f"<paramPoly3 {values} {p_range}/>")).at(s + step)
    np.testing.assert_allclose(heading, np.arctan2(ahead[1] - y, ahead[0] - x) % (2 * np.pi), atol=1e-4)


def test_each_distance_has_the_geometry_that_it_lies_in():
    element = road("<line/>", length=10.0)
    element.find("planView").extend(road('<arc curvature="0.1"/>', s=10.0, length=5.0).find("planView"))
    plan = plan_view.read(element)
    assert plan.end == 15.0
    x, _, heading = plan.at(np.array([9.999, 10.0, 15.0]))
    np.testing.assert_allclose(heading, [2.1, 2.1, 2.6], atol=1e-9)
    np.testing.assert_allclose(x[1], 100)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<road/>", "no planView with a geometry"),
        ("<road><planView/></road>", "no planView with a geometry"),
        (ET.tostring(road("<circle/>")).decode(), "not a line, arc, spiral, poly3 or paramPoly3"),
        (ET.tostring(road("<arc/>")).decode(), "has arc without curvature"),
        (ET.tostring(road('<arc curvature="nan"/>')).decode(), "curvature 'nan', which is not a number"),
        (ET.tostring(road("<line/>", length=float("inf"))).decode(), "length 'inf', which is not a number"),
        (ET.tostring(road("<line/>", length=-1)).decode(), "does not ascend"),
    ],
)
def test_bad_plans_have_one_line(text, words):
    with pytest.raises(TaskError, match=words):
        plan_view.read(ET.fromstring(text))
