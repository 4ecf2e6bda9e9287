"""Workers: the same bits as one process, whatever is killed."""

import gc
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from tests.recordings.same import assert_same

from napari_fiberburst.errors import BurstError, ClusterError
from napari_fiberburst.io import open_recording
from napari_fiberburst.recordings import cluster
from napari_fiberburst.recordings.mosaic import mosaic
from napari_fiberburst.recordings.work import complete, is_begun


@pytest.fixture(scope="module")
def client():
    with cluster.workers(2) as client:
        yield client


def tell(work, stage, number):
    """Say which process does it, and which object the work is there."""
    (work.folder / f"{stage}-{number}.told").write_text(f"{os.getpid()} {id(work)}")
    time.sleep(0.1)


def die_once(work, stage, number):
    with (work.folder / f"{number}.calls").open("a") as calls:
        calls.write("called\n")
    if number == 2 and len((work.folder / "2.calls").read_text().split()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)


def fail(work, stage, number):
    with (work.folder / "calls").open("a") as calls:
        calls.write("called\n")
    raise BurstError("frame 7 cannot be decoded")


def test_two_workers_make_the_same_bits_as_this_process(client, clip, unbroken, tmp_path):
    mosaic(open_recording(clip), tmp_path / "m.ome.zarr", client=client)
    assert_same(tmp_path, unbroken)


def test_a_worker_takes_the_work_once_for_all_stages(client, work):
    work.begin("more")
    for stage in ("some", "more"):
        assert sorted(number for number, _ in complete(tell, stage, work, range(6), client)) == list(range(6))
    told = {tuple(path.read_text().split()) for path in work.folder.glob("*.told")}
    assert len(told) == len({process for process, _ in told}) == 2
    assert str(os.getpid()) not in {process for process, _ in told}


def test_a_lost_worker_costs_its_unit_alone(client, work):
    assert sorted(number for number, _ in complete(die_once, "some", work, range(6), client)) == list(range(6))
    counts = [len((work.folder / f"{number}.calls").read_text().split()) for number in range(6)]
    assert counts == [1, 1, 2, 1, 1, 1]


def test_an_error_of_ours_is_not_tried_again(client, work):
    with pytest.raises(BurstError, match=r"^frame 7 cannot be decoded \(some, unit 3\)$"):
        list(complete(fail, "some", work, [3], client))
    assert (work.folder / "calls").read_text() == "called\n"


def test_a_killed_client_goes_on_to_the_same_bits(clip, unbroken, tmp_path):
    """It is killed at two moments drawn from the time that work takes, and then left to its end."""
    output = tmp_path / "m.ome.zarr"
    script = (
        "import sys; from napari_fiberburst.io import open_recording; from napari_fiberburst.recordings.mosaic "
        "import mosaic; source = open_recording(sys.argv[1]); print('begun', flush=True); mosaic(source, sys.argv[2])"
    )
    left = np.random.default_rng(3).uniform(0.2, 2.0, 2).tolist()
    begun = []
    while not output.exists() or is_begun(tmp_path / "m.work"):
        words = [sys.executable, "-c", script, str(clip), str(output)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": _SOURCE}) as process:
            process.stdout.readline()
            if left:
                time.sleep(left.pop())
                process.kill()
            process.communicate(timeout=120)
        begun.append(process.returncode)
    assert begun[:-1]
    assert set(begun[:-1]) == {-signal.SIGKILL}
    assert_same(tmp_path, unbroken)


_SOURCE = str(Path(cluster.__file__).parents[2])


def test_none_are_asked_for():
    with cluster.workers() as client:
        assert client is None


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_a_scheduler_that_is_not_there_is_said_soon(address, monkeypatch):
    monkeypatch.setattr(cluster, "_PATIENCE", 1)
    with (
        pytest.raises(ClusterError, match=f"no scheduler answers at {address} .*dask scheduler"),
        cluster.workers(scheduler=address),
    ):
        pass
    # A client that came to nothing is closed when it is collected. In the thread that the next one starts, that would
    # wait for a lock which is held until the thread has started.
    gc.collect()


def test_a_scheduler_that_is_there_is_joined(client, work):
    with cluster.workers(scheduler=client.scheduler.address, shape=(40, 97, 121, 1)) as joined:
        assert list(complete(tell, "some", work, [0], joined)) == [(0, 0)]


def test_another_cluster_on_this_machine_is_not_in_the_way(work):
    with socket.socket() as taken:
        # The port of every cluster's dashboard; perhaps another program holds it already.
        with suppress(OSError):
            taken.bind(("127.0.0.1", 8787))
            taken.listen()
        with cluster.workers(1) as client:
            assert list(complete(tell, "some", work, [0], client)) == [(0, 0)]


class Elsewhere:
    """Stands for a client whose workers are as they are told."""

    def __init__(self, workers=1, memory=2**40, **packages):
        self._workers, self._memory = workers, memory
        here = {"packages": dict.fromkeys((*cluster._SAME, "python"), "1.2.3")}
        there = {"packages": here["packages"] | packages}
        self._told = {"client": here, "scheduler": here, "workers": {"tcp://a": here, "tcp://b": there}}

    def scheduler_info(self, n_workers):
        return {"workers": {f"tcp://{name}": {"memory_limit": self._memory} for name in range(self._workers)}}

    def get_versions(self, packages):
        return self._told


@pytest.mark.parametrize(
    ("elsewhere", "said"),
    [
        (Elsewhere(workers=0), "has no workers; start some with `dask worker tcp://x`"),
        (Elsewhere(torch="2.0.0"), r"run other versions \(torch 2.0.0 there, 1.2.3 here\); install the same ones"),
        (Elsewhere(napari_fiberburst=None), r"\(napari_fiberburst missing there, 1.2.3 here\)"),
        (Elsewhere(python="1.3.0"), r"\(python 1.3 there, 1.2 here\)"),
        (Elsewhere(memory=2**30), "a worker of tcp://x has 1.0 GiB of memory, and this recording needs about 2.0 GiB"),
    ],
)
def test_workers_that_do_not_do_are_refused(elsewhere, said):
    with pytest.raises(ClusterError, match=said):
        cluster._check(elsewhere, "tcp://x", 2**31)


def test_workers_that_are_alike_but_for_a_patch_of_python_do():
    cluster._check(Elsewhere(python="1.2.4"), "tcp://x", 2**31)


def test_more_workers_than_there_is_memory_for_are_refused():
    with (
        pytest.raises(ClusterError, match=r"need about .* GiB of memory each, .*; take \d+"),
        cluster.workers(10**6, shape=(1000, 512, 512, 1)),
    ):
        pass


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ClusterError, match=r"pip install 'napari-fiberburst\[cluster\]'"), cluster.workers(2):
        pass
