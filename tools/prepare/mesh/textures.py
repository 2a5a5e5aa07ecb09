"""Textures of a mesh file, and the plain colours of materials without a texture.

Mesh libraries ignore a texture that is missing or cannot be decoded; here it is an error that names the file.
Files that a mesh names are read only if they are in its folder or below.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy
from flexroad.tasks import memory
from flexroad.tasks.errors import TaskError
from flexroad.tools.prepare.images import check_pixels, image_errors

PIL = lazy("PIL")

REMEDY = "export it again, or make no orthophoto: --no-dop"
HELD, DECODING = 3, 9
"""Bytes per texel of a texture, and additional bytes while it is decoded."""
FACTOR = 8
"""Memory to read a mesh, as a multiple of the size of its files: text, numbers and copies of both."""


class Textures:
    """The textures of one mesh file; each is decoded once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = _texture_files(path)
        self._decoded: dict[Any, NDArray[np.uint8]] = {}

    def texture(self, visual: Any) -> NDArray[np.uint8] | None:
        """Return the texture of a material, ``(h, w, 3)``; None without a texture."""
        material = getattr(visual, "material", None)
        file = self.files.get(getattr(material, "name", "") or "") or self.files.get("")
        if file is None and self.path.suffix.lower() in (".glb", ".gltf"):
            file = getattr(material, "baseColorTexture", None)
        if file is None:
            return None
        key = file if isinstance(file, Path) else id(file)
        if key not in self._decoded:
            held = HELD * sum(image.size // 3 for image in self._decoded.values())
            self._decoded[key] = _decode(self.path, file, held)
        return self._decoded[key]

    def plain_colour(self, visual: Any) -> NDArray[np.uint8] | None:
        """Return the colour of a material without a texture, ``(3,)``; None without a colour."""
        material: Any = getattr(visual, "material", None)
        if "kd" in getattr(material, "kwargs", {}):
            return np.asarray(material.diffuse[:3], np.uint8)
        factor = getattr(material, "baseColorFactor", None)
        # Texture coordinates without a texture mean that the texture is missing.
        if factor is None or getattr(visual, "uv", None) is not None:
            return None
        linear = np.asarray(factor[:3], np.float64) / 255
        srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
        return (srgb * 255).round().astype(np.uint8)


def _texture_files(path: Path) -> dict[str, Path]:
    """Return the texture file by material; for PLY the material's name is empty."""
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
                    return {"": beside(path, words[2])}
    return {}


def _of_mtl(path: Path) -> dict[str, Path]:
    with path.open(encoding="utf-8", errors="replace") as file:
        library = next((line[6:].strip() for line in file if line.startswith("mtllib")), None)
    if library is None:
        return {}
    mtl = beside(path, library)
    if not mtl.is_file():
        raise TaskError(
            f"{path} needs the material file {library}, which is not beside it; put it there, or make no "
            "orthophoto: --no-dop",
            file=str(path),
        )
    files, material = {}, ""
    for line in mtl.read_text(encoding="utf-8", errors="replace").splitlines():
        key, _, value = line.strip().partition(" ")
        if key.lower() == "newmtl":
            material = value.strip()
        elif key.lower() == "map_kd":
            files[material] = beside(path, value.strip().replace("\\", "/"))
    return files


def _decode(path: Path, source: Any, held: int) -> NDArray[np.uint8]:
    """Return a texture, ``(h, w, 3)``, from a file or an open image; other textures use ``held`` bytes."""
    name = f"the texture {source} of {path}" if isinstance(source, Path) else f"the texture in {path}"
    if isinstance(source, Path) and not source.is_file():
        raise TaskError(
            f"{path} needs the texture {source}, which does not exist; put it there, or make no orthophoto: "
            "--no-dop",
            file=str(path),
        )
    with image_errors(f"{name} cannot be read", REMEDY, path):
        image = PIL.Image.open(source) if isinstance(source, Path) else source
        check_pixels(image, name, REMEDY, path)
        memory.check(held + DECODING * image.width * image.height, name, "use smaller textures", str(path))
        return np.asarray(image.convert("RGB"))


def beside(mesh: Path, name: str) -> Path:
    """Return a file that a mesh names."""
    folder = mesh.parent.resolve()
    try:
        path = (folder / name).resolve()
        if path.is_relative_to(folder):
            return path
    except (OSError, RuntimeError, ValueError):
        # A name with a null byte, a name that is too long, or a loop of links.
        pass
    raise TaskError(
        f"{mesh} needs the file {name[:200]!r}, which is not in its folder; copy it there and name it "
        "without folders, or make no orthophoto: --no-dop",
        file=str(mesh),
    )


class Beside:
    """Resolver for trimesh: gives it the material file or the buffers that a mesh names.

    trimesh continues without files that it does not get. So the reason is kept for the caller.
    """

    def __init__(self, mesh: Path) -> None:
        self.mesh = mesh
        self.file_name = mesh.name
        self.refused: TaskError | None = None

    def __getitem__(self, name: str) -> bytes:
        """Return the content of a file."""
        try:
            path = beside(self.mesh, name.strip())
        except TaskError as error:
            self.refused = error
            raise FileNotFoundError(name) from error
        if not path.is_file():
            raise FileNotFoundError(name)
        memory.check(FACTOR * path.stat().st_size, f"{path} of {self.mesh}", "use a smaller mesh", str(path))
        return path.read_bytes()

    def get(self, name: str) -> bytes:
        """Raise an error: images of OBJ and PLY are read by `Textures`."""
        raise FileNotFoundError(name)
