"""PyFibreBundle (Hughes, 2023), the package itself, run as a script by a Python that has it.

It lives in an environment of its own, because its OpenCV brings a Qt that clashes with napari's; so this file imports
nothing of this project. It reads an npz and writes one:

    .venv-peers/bin/python benchmarks/peers/pyfibrebundle.py single|super|live IN.npz OUT.npz

In: `frames` (T, H, W, C) and `bundle` (H, W), an even white scene behind the same bundle, both with 1 as full scale
and black at 0; `centres` (N, 2), the true layout, or none, and then the package finds cores `pitch` apart itself;
`x`, `y` and `size`: the square of frame 0 to draw, pixels, and `grid`, its pixels a side. Out: `image` (grid, grid,
C) and `seconds`, which leave out starting Python; of "live", the last frame's image, and what one frame takes in the
median once all is calibrated and compiled.
"""

import sys
import time

import numpy as np
import pybundle
from pybundle import SuperRes
from scipy.ndimage import distance_transform_edt


def single_calibration(inputs):
    """Calibrate for one frame: where the cores are, and how bright each is."""
    half = (float(inputs["size"]) - 1) / 2
    centre_x, centre_y, grid = float(inputs["x"]) + half, float(inputs["y"]) + half, int(inputs["grid"])
    look = {"filterSize": None, "normalise": inputs["bundle"], "mask": False}
    if "centres" not in inputs:
        return pybundle.calib_tri_interp(
            inputs["bundle"],
            float(inputs["pitch"]),
            grid,
            centreX=centre_x,
            centreY=centre_y,
            radius=half,
            autoMask=True,
            **look,
        )
    height, width = inputs["bundle"].shape
    places = np.rint(inputs["centres"]).astype(int)
    inside = ((places >= 0) & (places < (width, height))).all(axis=1)
    x, y = places[inside].astype("uint16").T
    lit = inputs["bundle"][y, x] > 0.05  # dead cores are known too
    calibration = pybundle.init_tri_interp(inputs["bundle"], x[lit], y[lit], centre_x, centre_y, half, grid, **look)
    calibration.nCores = int(lit.sum())
    return calibration


def one_frame(inputs, calibration):
    """Interpolate between the cores of frame 0."""
    channels = np.moveaxis(inputs["frames"][0], -1, 0)
    images = [pybundle.recon_tri_interp(channel, calibration, numba=False) for channel in channels]
    # What is normalised comes with 255 as full scale.
    return filled(np.stack(images, axis=-1) / 255, calibration)


def frame_by_frame(inputs, calibration):
    """Interpolate between the cores of each frame; return the last image, and the seconds of one.

    The compiled loops are timed; the image is drawn without them, because they round to whole intensities and, in
    version 1.3.6, take the wrong weight for one core of three where there is no mask.
    """
    took = []
    for frame in inputs["frames"][..., 0]:
        start = time.perf_counter()
        pybundle.recon_tri_interp(frame, calibration, numba=True)
        took.append(time.perf_counter() - start)
    return one_frame({"frames": inputs["frames"][-1:]}, calibration), float(np.median(took))


def all_frames(inputs, calibration):
    """Register the frames by translation, as the package does, and interpolate between the cores of all.

    Its registration gets the whole frame as reference and half of it as template, so that it finds shifts up to a
    quarter of the frame. Other sizes, frames without their mean or their shading, frames brought to one mean and the
    true shifts were tried on the bursts of the first table: all within half a decibel, none better throughout.
    """
    stacks = np.moveaxis(inputs["frames"], 0, 2)  # (H, W, T, C)
    grid, half = int(inputs["grid"]), calibration.radius
    drawn = [
        pybundle.recon_tri_interp(stacks[..., t, :].mean(axis=-1), calibration, numba=False)
        for t in range(stacks.shape[2])
    ]
    shifts = SuperRes.get_shifts(np.stack(drawn, axis=-1), templateSize=grid // 4, refSize=grid // 2, upsample=4)
    shifts = np.asarray(shifts, float) * 2 * half / grid
    centre = {"centreX": inputs["x"] + half, "centreY": inputs["y"] + half, "radius": half}
    images = []
    for channel in range(stacks.shape[3]):
        combined = SuperRes.calib_multi_tri_interp(
            inputs["bundle"],
            stacks[..., channel],
            float(inputs["pitch"]),
            grid,
            shifts=shifts,
            singleCalib=calibration,
            filterSize=calibration.filterSize,
            mask=False,
            **centre,
        )
        images.append(SuperRes.recon_multi_tri_interp(stacks[..., channel], combined, numba=False))
    return filled(np.stack(images, axis=-1), combined)


def filled(image, calibration):
    """Fill what lies beyond the outermost cores with what is nearest: the package leaves it black."""
    missing = (calibration.mapping < 0).reshape(image.shape[:2]) | ~np.isfinite(image).all(axis=-1)
    rows, columns = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return image[rows, columns]


def main():
    """Read, reconstruct, write."""
    method, given, wanted = sys.argv[1:]
    with np.load(given) as file:
        inputs = {name: file[name] for name in file.files}
    start = time.perf_counter()
    calibration = single_calibration(inputs)
    if method == "live":
        image, seconds = frame_by_frame(inputs, calibration)
    else:
        image = {"single": one_frame, "super": all_frames}[method](inputs, calibration)
        seconds = time.perf_counter() - start
    np.savez(wanted, image=image.astype(np.float32), seconds=seconds)


if __name__ == "__main__":
    main()
