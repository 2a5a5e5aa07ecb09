"""Scenes with known truth: streets, houses, trees and cars as functions of a seed and a place."""

from tasks.synthetic.layout import block
from tasks.synthetic.options import SceneOptions
from tasks.synthetic.scene import Scene, make_scene
from tasks.synthetic.spoilers import Kind

__all__ = ["Kind", "Scene", "SceneOptions", "block", "make_scene"]
