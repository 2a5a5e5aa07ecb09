"""Textured meshes and photographs."""

from pathlib import Path

from PIL import Image

from flexroad.tools.prepare.mesh.read import read_mesh
from flexroad.tools.prepare.photos.exif import read_shot
from tests.make_photos import exif
from tests.tools.prepare.mesh.test_hostile import PLACED, write

NAMES = ("m.obj", "ascii.ply", "m.ply", "m.glb", "m.gltf")


def make(folder: Path) -> list[Path]:
    made = [write(folder, name) for name in NAMES]
    Image.new("RGB", (64, 48), (9, 99, 200)).save(folder / "photo.jpg", exif=exif((0, 0, 50)))
    return [*made, folder / "material.mtl", folder / "material_0.png", folder / "photo.jpg"]


def read(path: Path) -> None:
    if path.suffix == ".jpg":
        read_shot(path)
    else:
        of_mesh = path.suffix in (".mtl", ".png", ".bin")
        read_mesh(path.parent / "m.obj" if of_mesh else path, **PLACED)
