"""Synthetic scenes with known truth: streets, houses, trees and cars, functions of seed and coordinates."""

from flexroad.tools.synthetic.layout import block
from flexroad.tools.synthetic.options import SceneOptions
from flexroad.tools.synthetic.scene import Scene, make_scene
from flexroad.tools.synthetic.spoilers import Kind

__all__ = ["Kind", "Scene", "SceneOptions", "block", "make_scene"]
