"""Road networks in XML for `flexroad lift`: the copy is XML with all roads of the file."""

import gzip
import re
import warnings
from pathlib import Path

import numpy as np

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks import TaskError
from flexroad.tools.lift import xml_text
from flexroad.tools.lift.driver import XML_FORMATS
from flexroad.tools.lift.types import Options
from tests.tools.lift import test_osm, test_sumo
from tests.tools.lift.test_opendrive import ARC, road, structure, write

SPIRAL = (
    '<geometry s="0" x="1" y="2" hdg="3" length="{length}"><spiral curvStart="0" curvEnd="-0.1"/></geometry>'
)
CUBIC = '<geometry s="0" x="1" y="2" hdg="3" length="{length}"><poly3 a="0" b="0" c="0.01" d="0"/></geometry>'
PARAMETRIC = (
    '<geometry s="0" x="1" y="2" hdg="3" length="{length}"><paramPoly3 pRange="normalized" aU="0" bU="9" '
    'cU="0" dU="0" aV="0" bV="0" cV="1" dV="-1"/></geometry>'
)
HEADER = '<geoReference><![CDATA[+proj=utm +zone=32]]></geoReference><offset x="1" y="2" z="3" hdg="0"/>'

VALUES = (
    *"nan inf -1 0 1e308 -1e-300 x 50000 1e5 -0.5 ../../a true arcLength &#0; &lt;&quot;".split(),
    *("", "9" * 400),
)


def make(folder: Path) -> list[Path]:
    plans = (ARC, SPIRAL, CUBIC, PARAMETRIC)
    roads = [road(plan, 9.0, str(k), more=structure("tunnel", 2, 3)) for k, plan in enumerate(plans)]
    network = write(folder, *roads, header=HEADER)
    packed = folder / "packed.xodr.gz"
    packed.write_bytes(gzip.compress(network.read_bytes()))
    streets, nodes = folder / "a.net.xml", folder / "a.osm"
    streets.write_text(test_sumo.NET)
    nodes.write_text(test_osm.OSM)
    return [network, packed, streets, nodes]


def change(path: Path, data: bytes, rng: np.random.Generator) -> bytes:
    """Return a copy with other values of some attributes, or without some elements, that still is XML."""
    if rng.random() < 0.2:
        return b""
    packed = path.suffix == ".gz"
    text = (gzip.decompress(data) if packed else data).decode()
    values = list(re.finditer(r'(?<==)"[^"]*"|<\w+ [^>]*/>', text))
    for each in sorted(rng.choice(len(values), rng.integers(1, 4), replace=False))[::-1]:
        start, end = values[each].span()
        new = "" if text[start] == "<" else f'"{rng.choice(VALUES)}"'
        text = text[:start] + new + text[end:]
    return gzip.compress(text.encode()) if packed else text.encode()


def read(path: Path) -> None:
    out = path.with_name(f"out-{path.name}")
    name = xml_text.root_name(path)
    if name not in XML_FORMATS:
        raise TaskError(f"has the root element {name[:40]}")
    module = XML_FORMATS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        module.frame(path)
        options = Options(beyond="flat", add_vertices=True)
        list(module.lift(path, out, heights, options))
    # Nodes are added to OSM files.
    assert _count(path) <= _count(out)


def _count(path: Path) -> int:
    return sum(1 for _ in xml_text.elements(path, {"road", "node", "edge"}))


def heights(x: np.ndarray, y: np.ndarray) -> Heights:
    """The ground, and a deck at some places; NaN beyond 10 km."""
    near = (np.abs(x) < 1e4) & (np.abs(y) < 1e4)
    ground = np.where(near, 100 + 0.05 * np.where(near, x, 0.0), np.nan)
    return Heights((0, 1), np.stack([ground, np.where(np.abs(y) < 3, ground + 6, np.nan)]))
