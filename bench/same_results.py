"""Compare the results of this checkout with the results of another checkout, byte by byte.

Both run each configuration over the same synthetic tiles, with the same interpreter. Compared are the
fingerprints (names of the files in the store), the bytes of all products and mosaics. Also compared are the
metrics without times, and the sources, nodes and versions in each tile's item. The exit code is 1 if
something differs.

Usage: ``python bench/same_results.py OTHER_CHECKOUT [--tiles 12] [--configs production paper]``, with
``--other-options`` if the checkouts have different options: fingerprints and nodes are then not compared.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from flexroad.pipeline import ONE_THREAD
from flexroad.tools.synthetic.scenes import write_scenes

HERE = Path(__file__).parents[1]
SEED, SIZE_M = 7, 120
PRODUCTS = (".glb", ".ply", ".tif", ".npz", ".vrt")
ITEM = ("fingerprint", "nodes", "sources", "versions", "notes")
"""Properties of an item that are compared, after ``flexroad:``."""
COMMAND = """
import sys, flexroad
assert flexroad.__file__ == sys.argv.pop(1), f"{flexroad.__file__} is imported, not the checkout"
from flexroad.pipeline.cli.main import main
main()
"""


def run(root: Path, catalog: Path, config: str, out: Path, compared: Sequence[str]) -> dict[str, str]:
    """Run a configuration with a checkout; return its results by name."""
    words = ["run", "--config", config, "--catalog", str(catalog), "--out", str(out), "--executor", "serial"]
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(root)}
    command = [sys.executable, "-c", COMMAND, str(root / "flexroad" / "__init__.py"), *words]
    # It runs in another folder: Python would import the package of the current folder.
    subprocess.run(command, cwd=catalog.parent, env=environment, check=True)
    stored = (out / "store").rglob("*.npz") if "fingerprint" in compared else ()
    results = {str(path.relative_to(out)): "stored" for path in stored}
    for path in out.rglob("*"):
        if path.suffix in PRODUCTS and out / "store" not in path.parents:
            results[str(path.relative_to(out))] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.name == "item.json":
            properties = json.loads(path.read_text())["properties"]
            kept = {name: properties[f"flexroad:{name}"] for name in compared}
            results[str(path.relative_to(out))] = json.dumps(kept, sort_keys=True)
    metrics = pd.read_parquet(out / "metrics.parquet").drop(columns="seconds")
    for (tile, variant), row in metrics.set_index(["tile_id", "variant"]).iterrows():
        results[f"metrics of {tile}, {variant}"] = row.to_json(double_precision=15)
    return results


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("other", type=Path, help="folder of the other checkout")
    parser.add_argument("--tiles", type=int, default=12, help=f"tiles of {SIZE_M} m")
    parser.add_argument("--configs", nargs="+", default=("production", "paper"))
    parser.add_argument("--other-options", action="store_true", help="do not compare fingerprints")
    options = parser.parse_args()
    differing = 0
    compared = ITEM[2:] if options.other_options else ITEM
    with tempfile.TemporaryDirectory(prefix="same-results-") as folder:
        catalog = write_scenes(Path(folder, "survey"), options.tiles, seed=SEED, size_m=SIZE_M)
        for config in options.configs:
            other, this = (
                run(root, catalog, config, Path(folder, name, config), compared)
                for name, root in (("other", options.other.resolve()), ("this", HERE))
            )
            different = sorted(name for name in other.keys() | this if other.get(name) != this.get(name))
            print(f"{config}: {len(other)} results of the other checkout, {len(different)} differ")
            print("".join(f"  {name}\n" for name in different[:20]), end="")
            differing += len(different)
    return int(differing > 0)


if __name__ == "__main__":
    sys.exit(main())
