"""``flexroad catalog synthetic``: scenes with known truth, as functions of seed and coordinates.

For tests, benchmarks and a first try. Start at `scenes.write_scenes`, then `scene.make_scene`: streets,
houses, trees and cars of one tile.
"""

from flexroad.tools.synthetic.scene import Scene, make_scene
from flexroad.tools.synthetic.spoilers import Kind
from flexroad.tools.synthetic.world import SceneOptions, block

__all__ = ["Kind", "Scene", "SceneOptions", "block", "make_scene"]
