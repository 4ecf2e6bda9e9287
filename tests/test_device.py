"""Threads: more than there are processors for, and after a fork."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from napari_fiberburst import reconstruct
from napari_fiberburst.device import find_device, settle_threads
from napari_fiberburst.errors import DeviceError

AFTER_A_FORK = """
import os, sys, torch
from napari_fiberburst import reconstruct
from napari_fiberburst.simulation import simulate
torch.set_num_threads(2)
burst = simulate("cat", shape=(63, 70), frames=4, physics="core", pitch=6.0).burst
image = reconstruct(burst, iterations=1).image
child = os.fork()
if child == 0:
    again = reconstruct(burst, iterations=1).image
    os._exit(0 if (again == image)[image == image].all() else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_no_more_threads_than_processors(caplog):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(4 * (os.cpu_count() or 1))
        settle_threads()
        assert torch.get_num_threads() <= (os.cpu_count() or 1)
        assert [record.levelname for record in caplog.records] == ["WARNING"]
        settle_threads()
        assert len(caplog.records) == 1
    finally:
        torch.set_num_threads(before)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_process_makes_the_same_image():
    # Without care torch waits for threads that the fork has not taken along, for ever.
    assert subprocess.run([sys.executable, "-c", AFTER_A_FORK], timeout=240).returncode == 0


def test_apples_gpus_are_taken_by_nobody_who_needs_double_precision(monkeypatch):
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert find_device("auto").type == "cpu"
    assert find_device("mps", needs_double=False).type == "mps"
    with pytest.raises(DeviceError, match="no double precision"):
        reconstruct(np.random.default_rng(0).integers(0, 99, (3, 33, 41), dtype=np.uint8), device="mps")
