"""The textures a mesh file names, and the plain colours of materials that have none.

Readers of meshes pass over a texture they cannot find or decode; here it is an error that names the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.errors import TaskError


class Images:
    """The textures of one file, decoded once each."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = _texture_files(path)
        self._held: dict[Any, NDArray[np.uint8]] = {}

    def of(self, visual: Any) -> NDArray[np.uint8] | None:
        """Return the texture of a material, if it has one."""
        material = getattr(visual, "material", None)
        file = self.files.get(getattr(material, "name", "") or "") or self.files.get("")
        if file is None and self.path.suffix.lower() in (".glb", ".gltf"):
            file = getattr(material, "baseColorTexture", None)
        if file is None:
            return None
        key = file if isinstance(file, Path) else id(file)
        if key not in self._held:
            self._held[key] = _decoded(self.path, file)
        return self._held[key]

    def plain(self, visual: Any) -> NDArray[np.uint8] | None:
        """Return the one colour of a material without a texture, ``(3,)``."""
        material: Any = getattr(visual, "material", None)
        if "kd" in getattr(material, "kwargs", {}):
            return np.asarray(material.diffuse[:3], np.uint8)
        factor = getattr(material, "baseColorFactor", None)
        # Texture coordinates without a texture tell of one that got lost.
        if factor is None or getattr(visual, "uv", None) is not None:
            return None
        linear = np.asarray(factor[:3], np.float64) / 255
        srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
        return (srgb * 255).round().astype(np.uint8)


def _texture_files(path: Path) -> dict[str, Path]:
    """Return the texture file of each material; the one of a PLY has no name."""
    suffix = path.suffix.lower()
    if suffix == ".obj":
        return _of_mtl(path)
    if suffix == ".ply":
        with path.open("rb") as file:
            for line in iter(file.readline, b""):
                words = line.decode("utf-8", "replace").strip().split(maxsplit=2)
                if words[:1] == ["end_header"]:
                    break
                if words[:2] == ["comment", "TextureFile"] and len(words) == 3:
                    return {"": path.parent / words[2]}
    return {}


def _of_mtl(path: Path) -> dict[str, Path]:
    with path.open(encoding="utf-8", errors="replace") as file:
        library = next((line[6:].strip() for line in file if line.startswith("mtllib")), None)
    if library is None:
        return {}
    mtl = path.parent / library
    if not mtl.is_file():
        raise TaskError(
            f"{path} takes its materials from {library}, which is not beside it; put it there, or leave the "
            "orthophoto out: --no-dop",
            file=str(path),
        )
    files, material = {}, ""
    for line in mtl.read_text(encoding="utf-8", errors="replace").splitlines():
        key, _, value = line.strip().partition(" ")
        if key.lower() == "newmtl":
            material = value.strip()
        elif key.lower() == "map_kd":
            files[material] = path.parent / value.strip().replace("\\", "/")
    return files


def _decoded(path: Path, source: Any) -> NDArray[np.uint8]:
    """Return a texture as ``(h, w, 3)``, from a file or from an image that is open already."""
    from PIL import Image

    name = source if isinstance(source, Path) else "inside"
    if isinstance(source, Path) and not source.is_file():
        raise TaskError(
            f"{path} wants the texture {source}, which is not there; put it there, or leave the orthophoto "
            "out: --no-dop",
            file=str(path),
        )
    # An atlas of 16,384 x 16,384 texels is no attack.
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        image = Image.open(source) if isinstance(source, Path) else source
        return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise TaskError(
            f"the texture {name} of {path} cannot be read: {error}; export it again, or leave the orthophoto "
            "out: --no-dop",
            file=str(path),
        ) from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit
