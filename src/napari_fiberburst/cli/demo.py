"""``fiberburst demo``: a burst, its reconstruction, and how far it gets, in seconds."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

from napari_fiberburst.data.burst import Burst
from napari_fiberburst.errors import OutputError
from napari_fiberburst.io.picture import write_png
from napari_fiberburst.io.results import check_place
from napari_fiberburst.quality import match_levels, motion_error, psnr, ssim
from napari_fiberburst.results.reconstruction import Reconstruction
from napari_fiberburst.simulation import simulate

# A bundle as real ones are: each core shows one value, the mean of what it gathers.
_BURST = {"scene": "histology", "shape": (256, 256), "frames": 20, "pitch": 6.0, "physics": "core", "seed": 0}
_CAPTION_HEIGHT = 34


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "demo",
        help="simulate a burst, reconstruct it, and compare",
        description="Simulate a burst, reconstruct it, print how close it comes, and draw it.",
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("demo.png"), help="image, default demo.png")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, mps")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Simulate, reconstruct, print, draw."""
    if options.output.suffix != ".png":
        raise OutputError(f"the demo draws a .png file; got {options.output}")
    check_place(options.output)
    simulated = simulate(**_BURST)  # type: ignore[arg-type]
    print(f"simulated: {simulated.burst}, cores {_BURST['pitch']} px apart, object moving")
    result = _fit(simulated.burst, options.device)
    truth = simulated.truth[0]
    captured = simulated.burst.frames[0]
    images = {
        "captured frame": captured,
        "Gaussian filter": _best_gaussian(captured, truth),
        "reconstruction": result.image / np.float32(simulated.burst.white_level),
    }
    print(f"{'':16}  PSNR dB   SSIM   (frame 0, after one gain and offset per channel)")
    for name, image in images.items():
        print(f"{name:16}  {psnr(image, truth):7.2f}  {ssim(image, truth):5.3f}")
    shape = truth.shape[:2]
    error = motion_error(result.homographies, simulated.homographies, shape)
    still = motion_error(np.broadcast_to(np.eye(3), (len(simulated.truth), 3, 3)), simulated.homographies, shape)
    print(f"motion off by {error:.2f} px on average; unregistered {still:.2f} px")
    write_png(options.output, _side_by_side({**images, "truth": truth}, truth))
    print(f"samples left out are met to {result.held_out_rmse:.2f} of 255; resolution {result.resolution:.1f} px")
    print(f"{result.seconds:.1f} s on {result.device}; wrote {options.output}")
    return 0


def _fit(burst: Burst, device: str) -> Reconstruction:
    """Return the reconstruction, with a progress bar meanwhile."""
    from napari_fiberburst.pipeline.reconstruct import reconstruct  # torch takes seconds to load
    from napari_fiberburst.results.progress import Progress

    with tqdm(unit="it", desc="reconstructing") as bar:

        def show(report: Progress) -> None:
            bar.total = report.iterations
            bar.update(report.step - bar.n)

        return reconstruct(burst, device=device, fill=True, on_progress=show)


def _best_gaussian(captured: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the frame filtered by the sigma that comes closest to the truth: the filter at its best."""
    filtered = [gaussian_filter(captured, (sigma, sigma, 0)) for sigma in np.arange(0.5, 4.1, 0.25)]
    return max(filtered, key=lambda image: psnr(image, truth))


def _side_by_side(images: dict[str, NDArray[np.float32]], truth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a sheet of the images with their captions, all at the truth's levels but the captured one."""
    height, width = truth.shape[:2]
    sheet = Image.new("RGB", (len(images) * (width + 8) - 8, height + _CAPTION_HEIGHT), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=12)
    for index, (name, image) in enumerate(images.items()):
        is_raw = name == "captured frame"
        shown = np.clip(image if is_raw else match_levels(image, truth), 0, 1)
        x = index * (width + 8)
        sheet.paste(Image.fromarray(np.rint(shown * 255).astype(np.uint8)), (x, _CAPTION_HEIGHT))
        draw.text((x + 2, 1), name, fill="black", font=font)
        if name != "truth":
            draw.text((x + 2, 16), f"{psnr(image, truth):.1f} dB / {ssim(image, truth):.2f}", fill="black", font=font)
    return np.asarray(sheet)
