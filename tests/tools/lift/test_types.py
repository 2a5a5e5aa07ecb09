"""Heights of many parts at a time, each with its own."""

import numpy as np

from flexroad.pipeline.run.sampler import Heights
from flexroad.tools.lift import types


def test_each_part_has_its_heights_in_order_whatever_the_batch(monkeypatch):
    asked = []

    def heights(x, y):
        asked.append(len(x))
        return Heights((0,), (x + y)[None])

    parts = [*"ab", 3, 0, *"c", 5]
    for size in (1, 4, 100):
        monkeypatch.setattr(types, "POINTS", size)
        found = types.with_heights(
            parts,
            lambda part: types.NO_POINTS if isinstance(part, str) else (np.arange(part), np.ones(part)),
            heights,
        )
        result = [(part, own.ground.tolist()) for part, own in found]
        assert [part for part, _ in result] == parts
        assert [own for _, own in result] == [[], [], [1, 2, 3], [], [], [1, 2, 3, 4, 5]]
    assert asked[-1] == 8
