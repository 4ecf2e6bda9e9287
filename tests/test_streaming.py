"""The mailbox keeps the newest item alone, whichever thread puts it."""

import threading
import weakref

from napari_fiberburst.streaming import Latest


class Image:
    """Something that can be watched while it is let go."""


def test_only_the_newest_item_is_kept_alive():
    box, images = Latest[Image](), []
    for _ in range(50):
        image = Image()
        images.append(weakref.ref(image))
        box.put(image)
    del image
    assert [number for number, image in enumerate(images) if image() is not None] == [49]
    assert isinstance(box.take(), Image)
    assert box.take() is None


def test_a_fast_thread_never_blocks_and_the_last_item_arrives():
    box, seen = Latest[int](), []
    writer = threading.Thread(target=lambda: [box.put(number) for number in range(10_000)])
    writer.start()
    while writer.is_alive():
        item = box.take()
        if item is not None:
            seen.append(item)
    last = box.take()
    seen += [] if last is None else [last]
    assert seen[-1] == 9_999
    assert seen == sorted(seen)
