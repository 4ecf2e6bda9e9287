"""Video clips whose frames say in their pixels which they are."""

from fractions import Fraction

import av
import numpy as np

HEIGHT, WIDTH = 50, 70
_BLOCK = 8


def drawn(number, shape=(HEIGHT, WIDTH), full=255):
    """Return a frame that holds its number as 16 black and white blocks, above a pattern that moves."""
    frame = np.zeros(shape, np.uint8 if full < 256 else np.uint16)
    for bit in range(16):
        y, x = 2 + _BLOCK * (bit // 8), 2 + _BLOCK * (bit % 8)
        frame[y : y + _BLOCK, x : x + _BLOCK] = full * 7 // 8 if number >> bit & 1 else full // 8
    y, x = np.indices(shape)
    frame[20:] = (full * (0.5 + 0.3 * np.sin((x + 2 * number) / 5) * np.cos(y / 4)))[20:]
    return frame


def number_of(frame, full=255):
    """Return the number that a frame, (H, W) or (H, W, C), holds."""
    grey = frame if frame.ndim == 2 else frame.mean(axis=2)
    found = 0
    for bit in range(16):
        y, x = 2 + _BLOCK * (bit // 8), 2 + _BLOCK * (bit % 8)
        found |= int(grey[y + 2 : y + _BLOCK - 2, x + 2 : x + _BLOCK - 2].mean() > full / 2) << bit
    return found


def write_clip(path, codec, pixels, frames, *, options=None, rate=25, group=None, between=None, at=None):
    """Write frames as a video.

    `group` is the distance of key frames and `between` the number of B-frames; `at` gives each frame's time in ms.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        if group is not None:
            stream.gop_size = group
        if between is not None:
            stream.codec_context.max_b_frames = between
        if at is not None:
            stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        for number, frame in enumerate(frames):
            kind = {2: "gray" if frame.dtype == np.uint8 else "gray16le", 3: "rgb24"}[frame.ndim]
            shown = av.VideoFrame.from_ndarray(frame, format=kind)
            shown = shown if kind == pixels else shown.reformat(format=pixels)
            shown.pts = number if at is None else at[number]
            shown.time_base = Fraction(1, rate) if at is None else Fraction(1, 1000)
            container.mux(stream.encode(shown))
        container.mux(stream.encode(None))
    return path


# Name of the file, codec, format of its pixels, and how it is coded.
CLIPS = {
    "motion jpeg": ("a.avi", "mjpeg", "yuvj420p", {}),
    "h264": ("a.mp4", "libx264", "yuv420p", {"options": {"bf": "3", "g": "24"}}),
    "one long group": ("a.mp4", "libx264", "yuv420p", {"options": {"bf": "3", "g": "999", "sc_threshold": "0"}}),
    "open groups": ("a.mp4", "libx264", "yuv420p", {"options": {"bf": "3", "g": "12", "x264-params": "open-gop=1"}}),
    "renewed in parts": ("a.ts", "libx264", "yuv420p", {"options": {"x264-params": "intra-refresh=1:keyint=20"}}),
    "h264 in avi, times wrong": ("a.avi", "libx264", "yuv420p", {"options": {"bf": "3", "g": "16"}}),
    "bare h264, without times": ("a.h264", "libx264", "yuv420p", {"options": {"bf": "3", "g": "16"}}),
    "transport stream": ("a.ts", "libx264", "yuv420p", {"options": {"bf": "3", "g": "16"}}),
    "mpeg-1": ("a.mpg", "mpeg1video", "yuv420p", {"group": 12, "between": 2}),
    "bare mpeg-1": ("a.m1v", "mpeg1video", "yuv420p", {"group": 12, "between": 2}),
    "mpeg-4 in avi": ("a.avi", "mpeg4", "yuv420p", {"group": 12, "between": 2}),
    "ffv1": ("a.mkv", "ffv1", "gray", {}),
    "ffv1 in avi": ("a.avi", "ffv1", "gray", {"group": 1}),
    "vp8, with packets that are never shown": (
        "a.webm",
        "libvpx",
        "yuv420p",
        {"options": {"auto-alt-ref": "1", "lag-in-frames": "10"}},
    ),
    "uncompressed": ("a.avi", "rawvideo", "bgr24", {}),
}


def clip(folder, kind, count=90):
    """Write one of `CLIPS`, whose frames hold their numbers."""
    name, codec, pixels, coded = CLIPS[kind]
    return write_clip(folder / name, codec, pixels, [drawn(number) for number in range(count)], **coded)
