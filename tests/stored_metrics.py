"""The figures that `flexroad tables` stores beside its pages, read back."""

from pathlib import Path

import pandas as pd

from flexroad.pipeline.store.tables import frame_of
from flexroad.tools.reproduce.metrics_data import DSC3D_FILE, DSM_FILE, FILE, KEYS, LITERAL_FILE, MetricsData


def read_metrics_data(folder: Path) -> MetricsData:
    """Read the files of `write_metrics_data`."""
    dsc3d = _read(folder / DSC3D_FILE) if (folder / DSC3D_FILE).exists() else pd.DataFrame({"dataset": []})
    parts = [rows for _, rows in dsc3d.groupby("dataset", sort=False)]
    literal, dsm = (
        MetricsData(_read(folder / name)) if (folder / name).exists() else None
        for name in (LITERAL_FILE, DSM_FILE)
    )
    scenes = tuple(MetricsData(rows.reset_index(drop=True)) for rows in parts)
    return MetricsData(_read(folder / FILE), scenes, literal, dsm)


def _read(path: Path) -> pd.DataFrame:
    return frame_of(path.read_bytes()).astype(dict.fromkeys(KEYS, "str"))
