"""Synthetic scenes with known truth: streets, houses, trees and cars, functions of seed and coordinates."""

from flexroad.tasks.synthetic.layout import block
from flexroad.tasks.synthetic.options import SceneOptions
from flexroad.tasks.synthetic.scene import Scene, make_scene
from flexroad.tasks.synthetic.spoilers import Kind

__all__ = ["Kind", "Scene", "SceneOptions", "block", "make_scene"]
