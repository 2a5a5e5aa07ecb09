"""OpenDRIVE read literally by its specification, and checked by the program of ASAM."""

import subprocess
from math import cos, sin
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from tests import validators


def numbers(element: ET.Element, *names: str) -> list[float]:
    return [float(element.attrib[name]) for name in names]


def record(element: ET.Element, path: str, s: float, key: str = "s") -> ET.Element:
    """Return the last record that begins at or before s."""
    return [at for at in element.findall(path) if float(at.attrib[key]) <= s][-1]


def plan(element: ET.Element, s: float) -> tuple[float, float, float]:
    """Return x, y and heading at s, literally by the specification."""
    geometry = record(element, "planView/geometry", s)
    at, x, y, hdg, length = numbers(geometry, "s", "x", "y", "hdg", "length")
    cubic = geometry.find("paramPoly3")
    assert cubic is not None
    assert cubic.attrib["pRange"] == "normalized"
    p = (s - at) / length
    au, bu, cu, du = numbers(cubic, "aU", "bU", "cU", "dU")
    av, bv, cv, dv = numbers(cubic, "aV", "bV", "cV", "dV")
    u, v = au + bu * p + cu * p**2 + du * p**3, av + bv * p + cv * p**2 + dv * p**3
    turn = np.arctan2(bv + 2 * cv * p + 3 * dv * p**2, bu + 2 * cu * p + 3 * du * p**2)
    return x + u * cos(hdg) - v * sin(hdg), y + u * sin(hdg) + v * cos(hdg), hdg + turn


def polynomial(element: ET.Element, path: str, s: float, key: str = "s") -> float:
    found = record(element, path, s, key)
    at, a, b, c, d = numbers(found, key, "a", "b", "c", "d")
    return a + b * (s - at) + c * (s - at) ** 2 + d * (s - at) ** 3


def place(element: ET.Element, at: tuple[float, float, float], s: float, t: float) -> np.ndarray:
    """Return x, y, z at s and t: elevation and superelevation, with the plan at s."""
    x, y, heading = at
    lateral = element.findall("lateralProfile/superelevation")
    turn = polynomial(element, "lateralProfile/superelevation", s) if lateral else 0.0
    aside = t * cos(turn)
    z = polynomial(element, "elevationProfile/elevation", s) + t * sin(turn)
    return np.array([x - aside * sin(heading), y + aside * cos(heading), z])


def quality_issues(path: Path) -> list[dict[str, str]]:
    """Return what asam-qc-opendrive reports of a file; the schema and the rules of ASAM.

    Skips the test without the programs of `tests.validators`.
    """
    program, result = validators.program("qc_opendrive"), path.with_suffix(".xqar")
    config = path.with_suffix(".config.xml")
    config.write_text(
        f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="xodrBundle">'
        f'<Param name="resultFile" value="{result}"/></CheckerBundle></Config>'
    )
    subprocess.run([str(program), "-c", str(config)], check=True, capture_output=True)
    checkers = list(ET.parse(result).iter("Checker"))
    assert {"check_asam_xodr_xml_valid_schema"} <= {each.attrib["checkerId"] for each in checkers}
    return [issue.attrib for each in checkers for issue in each.iter("Issue")]
