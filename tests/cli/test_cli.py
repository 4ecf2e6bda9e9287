"""The command line, as a user types it."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial

import av
import numpy as np
import pytest
import tifffile
from PIL import Image
from tqdm import tqdm

from napari_fiberburst import __version__
from napari_fiberburst.__main__ import main as command_line
from napari_fiberburst.cli import demo, main, reconstruct
from napari_fiberburst.simulation import Faults, simulate, simulate_recording

SMALL = ["--preset", "paper", "--scene-width", "16", "--motion-width", "16", "--batch", "200", "--device", "cpu"]


@pytest.fixture
def burst_file(tmp_path):
    path = tmp_path / "tissue.burst"
    assert main(["simulate", "-o", str(path), "--shape", "33x41", "--frames", "3", "--pitch", "3"]) == 0
    return path


def test_simulate_writes_the_burst_and_its_truth(burst_file):
    with np.load(burst_file) as arrays:
        assert arrays["frames"].shape == arrays["truth"].shape == (3, 33, 41, 3)
        assert arrays["homographies"].shape == (3, 3, 3)
        assert arrays["transmission"].shape == (33, 41)


def test_simulate_takes_every_fault_as_an_option(tmp_path):
    path = tmp_path / "faulty.burst"
    command = ["simulate", "-o", str(path), "--shape", "43x51", "--frames", "5", "--pitch", "4", "--channels", "1"]
    faults = ["--flicker", "0.05", "--deformation", "2", "--deformation-length", "30", "--vignette", "3", "--overlay"]
    assert main([*command, *faults, "--black-frames", "1", "--contrast", "0.1"]) == 0
    simulated = simulate(
        shape=(43, 51),
        frames=5,
        pitch=4.0,
        channels=1,
        faults=Faults(
            flicker=0.05,
            deformation=2.0,
            deformation_length=30.0,
            vignette=3.0,
            overlay=True,
            black_frames=1,
            contrast=0.1,
        ),
    )
    with np.load(path) as arrays:
        assert set(arrays) == set(simulated.arrays())
        for name, array in simulated.arrays().items():
            np.testing.assert_array_equal(arrays[name], array)


def test_simulate_takes_a_flat_field_image_as_the_bundle(tmp_path):
    flat = simulate(shape=(67, 83), frames=1, pitch=6.0).transmission
    tifffile.imwrite(tmp_path / "flat.tif", np.rint(1000 * flat).astype(np.uint16))
    path = tmp_path / "tissue.burst"
    command = ["simulate", "-o", str(path), "--flat", str(tmp_path / "flat.tif"), "--frames", "3"]
    assert main([*command, "--physics", "core"]) == 0
    with np.load(path) as arrays:
        assert arrays["frames"].shape == (3, 67, 83, 3)
        bright = (flat > 0.4) & (arrays["transmission"] > 0)
        assert bright.mean() > 0.2
        np.testing.assert_allclose(
            arrays["transmission"][bright] / flat[bright], 1 / np.quantile(flat, 0.999), rtol=0.01
        )


def test_simulate_writes_a_recording_and_its_truth_beside_it(tmp_path):
    path = tmp_path / "clip.avi"
    command = [
        "simulate",
        "--recording",
        "handheld",
        "-o",
        str(path),
        "--shape",
        "43x51",
        "--frames",
        "30",
        "--seed",
        "3",
    ]
    options = ["--turn", "2", "--gaps", "1", "--jumps", "1", "--cells", "2", "--flicker", "0.05", "--pitch", "5"]
    assert main([*command, *options]) == 0
    recording = simulate_recording(
        shape=(43, 51), frames=30, path="handheld", seed=3, turn=2.0, gaps=1, jumps=1, cells=2, flicker=0.05, pitch=5.0
    )
    with av.open(path) as video:
        frames = np.stack([frame.to_ndarray(format="gray") for frame in video.decode(video=0)])
    np.testing.assert_array_equal(frames, recording.source.recorded(range(30))[..., 0])
    with np.load(tmp_path / "clip.truth.npz") as truth:
        assert {"homographies", "in_contact", "cuts", "cells", "traces"} <= set(truth)
        for name, array in recording.arrays().items():
            np.testing.assert_array_equal(truth[name], array)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--recording", "raster", "-o", "a.burst"], "a recording is written to a file ending in .avi, .mkv, .mp4"),
        (["--recording", "raster", "-o", "a.avi", "--smear", "0.5"], "smear is a fault of bursts; recordings have"),
        (["--recording", "raster", "-o", "a.avi", "--motion", "raster"], "leave --motion out"),
        (["--recording", "raster", "-o", "a.avi", "--scene", "cat"], "take fewer frames, smaller steps"),
        (["-o", "a.burst", "--laps", "2"], "--laps is of recordings; say by --recording where the probe goes"),
        (["-o", "a.burst", "--scene", "slide"], "unknown scene 'slide'"),
    ],
)
def test_simulate_tells_bursts_from_recordings(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", *options]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_simulate_refuses_faults_that_cannot_be(tmp_path, capsys):
    assert main(["simulate", "-o", str(tmp_path / "a.burst"), "--shape", "33x41", "--flicker", "-1"]) == 2
    assert "flicker must be a number of at least 0" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_info_tells_what_a_burst_holds(burst_file, capsys):
    assert main(["info", str(burst_file)]) == 0
    told = capsys.readouterr().out
    assert "33 x 41" in told
    assert "uint8" in told


def test_a_terminal_without_the_sign_of_the_micrometre_gets_what_it_can_show(tmp_path, rng, monkeypatch):
    frames = rng.integers(0, 256, (3, 33, 41), dtype=np.uint8)
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.75, "PhysicalSizeXUnit": "µm", "PhysicalSizeYUnit": "µm"}
    tifffile.imwrite(tmp_path / "zwölf.ome.tif", frames, photometric="minisblack", metadata={"axes": "TYX", **sizes})
    shown, said = (io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict") for _ in range(2))
    monkeypatch.setattr(sys, "stdout", shown)
    monkeypatch.setattr(sys, "stderr", said)
    assert main(["info", str(tmp_path / "zwölf.ome.tif")]) == 0
    assert rb"0.75 x 0.5 \xb5m" in shown.buffer.getvalue()
    assert main(["info", str(tmp_path / "elf\udcfc.tif")]) == 2
    said.flush()
    assert rb"elf\udcfc.tif" in said.buffer.getvalue()


@pytest.mark.parametrize("command", [["--version"], ["info", "burst.tif"]])
def test_a_pipe_that_nobody_reads_ends_the_command_quietly(tmp_path, rng, monkeypatch, capfd, command):
    monkeypatch.chdir(tmp_path)
    tifffile.imwrite("burst.tif", rng.integers(0, 256, (3, 33, 41), dtype=np.uint8), photometric="minisblack")
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert main(command) == 141
    assert capfd.readouterr().err == ""


def test_reconstruct_writes_an_image(burst_file, tmp_path, capsys):
    out = tmp_path / "image.ome.tif"
    assert main(["reconstruct", str(burst_file), "-o", str(out), "--iterations", "5", *SMALL]) == 0
    assert tifffile.imread(out).shape == (3, 33, 41)
    assert "finished after 5 steps" in capsys.readouterr().out


def test_reconstruct_takes_a_crop_and_settings_by_name(burst_file, tmp_path):
    out = tmp_path / "image.ome.tif"
    command = ["reconstruct", str(burst_file), "-o", str(out), "--crop", "5:25,10:40", "--encoding", "nerf"]
    assert main([*command, "--highest-octave", "3", "--iterations", "2", "--seed", "7", *SMALL]) == 0
    told = json.loads((tmp_path / "image.json").read_text())
    assert tifffile.imread(out).shape == (3, 20, 30)
    assert told["burst"]["origin"] == [5, 10]
    assert told["settings"]["method"]["encoding"] == {"name": "nerf", "highest_octave": 3}
    assert told["seed"] == 7


def test_reconstruct_writes_a_picture_for_a_quick_look(burst_file, tmp_path):
    out = tmp_path / "look.png"
    assert main(["reconstruct", str(burst_file), "-o", str(out), "--iterations", "5", *SMALL]) == 0
    with Image.open(out) as picture:
        assert (picture.mode, picture.size) == ("RGB", (41, 33))
        assert np.asarray(picture).max() == 255
    assert sorted(path.name for path in tmp_path.iterdir()) == ["look.png", "tissue.burst"]


def test_no_loss_is_shown_before_there_is_one(burst_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reconstruct, "tqdm", partial(tqdm, mininterval=0))
    assert main(["reconstruct", str(burst_file), "-o", str(tmp_path / "a.png"), "--device", "cpu"]) == 0
    told = capsys.readouterr()
    assert "loss=" in told.err
    assert "nan" not in told.err
    assert "finest detail" in told.out


def test_reconstruct_can_write_the_networks(burst_file, tmp_path):
    out = tmp_path / "scene.npz"
    assert main(["reconstruct", str(burst_file), "-o", str(out), "--iterations", "2", *SMALL]) == 0
    assert out.exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["--preset", "paper", "--sigma", "-1"], "sigma must be a number above 0 and"),
        (["--encoding", "siren", "--sigma", "3"], "belongs to encoding 'fourier'"),
        (["--crop", "0:99,0:20"], "within 0:33"),
        (["--device", "cuda:77"], "is not on this machine"),
        (["--iterations", "0"], "at least 1"),
        (["-o", "nowhere/image.tif"], "does not exist"),
        (["-o", "image.bmp"], "ending in"),
    ],
)
def test_bad_input_says_why_and_leaves_no_file(burst_file, tmp_path, capsys, change, said):
    out = [] if "-o" in change else ["-o", str(tmp_path / "image.tif")]
    assert main(["reconstruct", str(burst_file), *out, *change]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [burst_file]


def test_the_burst_is_not_written_over(burst_file, tmp_path, capsys):
    burst = burst_file.rename(tmp_path / "of_an_earlier_version.npz")
    before = burst.read_bytes()
    assert main(["reconstruct", str(burst), "-o", str(burst), "--iterations", "1", *SMALL]) == 2
    assert "would be lost" in capsys.readouterr().err
    assert burst.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send")
def test_ctrl_c_while_saving_lets_the_saving_end(burst_file, tmp_path, monkeypatch):
    fsync = os.fsync

    def interrupted(number):
        signal.raise_signal(signal.SIGINT) if os.fsync is interrupted and not seen else None
        seen.append(number)
        fsync(number)

    seen = []
    monkeypatch.setattr(os, "fsync", interrupted)
    out = tmp_path / "image.tif"
    assert main(["reconstruct", str(burst_file), "-o", str(out), "--iterations", "2", *SMALL]) == 0
    assert out.exists()
    assert (tmp_path / "image.json").exists()


def test_a_missing_burst_is_said(tmp_path, capsys):
    assert main(["info", str(tmp_path / "none.tif")]) == 2
    assert "there is no" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        ["reconstruct", "burst.npz", "-o", "a.tif", "--crop", "5-9"],
        ["reconstruct", "burst.npz", "-o", "a.tif", "--motion", "zoom"],
        ["simulate", "-o", "a.burst", "--shape", "9"],
        ["reconstruct"],
        [],
    ],
)
def test_what_cannot_be_parsed_shows_the_usage(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 2
    assert "usage: fiberburst" in capsys.readouterr().err


def test_help_comes_from_the_settings(capsys):
    with pytest.raises(SystemExit):
        main(["reconstruct", "--help"])
    told = " ".join(capsys.readouterr().out.split())
    assert "Frequency spread, cycles per half frame; more resolves finer detail" in told
    assert "--smoothness" in told
    assert "(spline only)" in told
    assert "homography: One homography per frame" in told
    assert "--canvas {frame,union}" in told
    assert "--fill, --no-fill" in told


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send")
def test_ctrl_c_writes_what_there_is(burst_file, tmp_path):
    out = tmp_path / "image.ome.tif"
    command = ["reconstruct", str(burst_file), "-o", str(out), "--iterations", "1000000", *SMALL]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", f"import sys; from napari_fiberburst.cli import main; sys.exit(main({command}))"],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    )
    seen = b""
    while b"loss" not in seen:  # it is running
        seen += process.stderr.read1()
    process.send_signal(signal.SIGINT)
    told, complaints = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"stopped after" in told
    assert b"writing what there is" in complaints
    assert tifffile.imread(out).shape == (3, 33, 41)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT to send")
def test_a_second_ctrl_c_ends_at_once(tmp_path):
    code = (
        "import time; from napari_fiberburst import Control\n"
        "from napari_fiberburst.cli.reconstruct import stop_on_interrupt\n"
        "with stop_on_interrupt(Control()):\n"
        "    try:\n"
        "        print('running', flush=True)\n"
        "        time.sleep(60)\n"
        "    except KeyboardInterrupt: print('ended', flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"running\n"
        process.send_signal(signal.SIGINT)
        assert b"again ends at once" in process.stderr.readline() + process.stderr.readline()
        start = time.monotonic()
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == b"ended\n"
    assert time.monotonic() - start < 30


def test_the_demo_prints_its_figures_and_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "_BURST", {**demo._BURST, "shape": (97, 113), "frames": 5})
    out = tmp_path / "demo.png"
    assert main(["demo", "-o", str(out), "--device", "cpu"]) == 0
    told = capsys.readouterr().out
    for line in ("captured frame", "Gaussian filter", "reconstruction", "motion off by"):
        assert line in told
    from imageio.v3 import imread

    image = imread(out)
    assert image.shape[1] == 4 * 113 + 3 * 8
    assert image.std() > 20


def test_the_demo_refuses_a_place_it_cannot_write(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "none" / "demo.png")]) == 2
    assert main(["demo", "-o", str(tmp_path / "demo.gif")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_ctrl_c_while_the_command_is_imported_is_a_line(monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr("napari_fiberburst.cli.main", interrupted)
    assert command_line() == 130
    assert capsys.readouterr().err == "\nfiberburst: interrupted; nothing was written\n"


def test_the_package_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "napari_fiberburst", "--version"], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout.split()[-1]) == (0, __version__)
