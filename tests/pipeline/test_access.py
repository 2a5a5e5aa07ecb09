"""Files that the system does not let this user read: they are not called damaged or missing."""

import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.scan import point_clouds, vectors
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks import TaskError
from flexroad.tools.prepare.mesh.read import read_mesh
from tests.permissions import permissions_enforced

READERS = {
    "a.laz": point_clouds.inspect,
    "a.gpkg": lambda path: vectors.opened(path, None),
    "metrics.parquet": lambda path: read_metrics(path.parent),
    "a.glb": read_mesh,
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("closed", ["file", "folder"])
def test_file_without_permission_is_neither_damaged_nor_missing(name, closed, tmp_path):
    path = tmp_path / "folder" / name
    path.parent.mkdir()
    path.write_bytes(b"content")
    (path if closed == "file" else path.parent).chmod(0)
    with (
        permissions_enforced(),
        pytest.raises((CatalogError, ConfigError, TaskError, PermissionError)) as error,
    ):
        READERS[name](path)
    path.parent.chmod(0o700)
    message = str(error.value)
    assert "Permission denied" in message
    assert str(path) in message
    for wrong in ("damaged", "is not", "missing", "exist", "again", "no model", "Errno"):
        assert wrong not in message or (wrong == "Errno" and isinstance(error.value, PermissionError)), (
            message
        )
