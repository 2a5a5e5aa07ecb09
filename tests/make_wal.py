"""A GeoPackage with an edit that is only in its -wal file, as QGIS leaves it after a crash."""

import sqlite3
import struct
import subprocess
import sys
from pathlib import Path

CODE = """
import os, sqlite3, sys
base = sqlite3.connect(sys.argv[1])
base.execute("PRAGMA wal_autocheckpoint=0")
base.execute(f"INSERT INTO {sys.argv[2]} (geom, width) VALUES (?, 8.0)", (bytes.fromhex(sys.argv[3]),))
base.commit()
os._exit(0)
"""


def in_wal_mode(path: Path) -> Path:
    """Have SQLite write changes of a GeoPackage to a -wal file from now on."""
    base = sqlite3.connect(path)
    assert base.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",)
    base.close()
    return path


def add_to_wal(path: Path, shape, table: str) -> None:
    """Add a feature with the width 8 in a process that ends before SQLite writes it into the file."""
    blob = b"GP\0\1" + struct.pack("<i", 25832) + shape.wkb
    subprocess.run([sys.executable, "-c", CODE, str(path), table, blob.hex()], check=True)
    assert path.with_name(path.name + "-wal").stat().st_size
