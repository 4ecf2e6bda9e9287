"""Loops are compiled where nothing can be kept on disk, too."""

import numpy as np
from numba.core import caching

from napari_fiberburst.live.compiled import compiled


def test_without_a_place_to_keep_them_loops_are_compiled_all_the_same(monkeypatch):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])

    @compiled("f8(f8[::1])")
    def total(values):
        found = 0.0
        for value in values:
            found += value
        return found

    assert total.signatures
    assert total(np.arange(5.0)) == 10
