"""What the dock can be asked to do with a burst, a recording or a camera, in the order it is offered."""

from napari_fiberburst.plugin.tasks.bundle import BundleTask
from napari_fiberburst.plugin.tasks.live import LiveTask
from napari_fiberburst.plugin.tasks.mosaic import MosaicTask
from napari_fiberburst.plugin.tasks.picture import PictureTask
from napari_fiberburst.plugin.tasks.task import Task
from napari_fiberburst.plugin.tasks.video import VideoTask

TASKS: tuple[type[Task], ...] = (PictureTask, VideoTask, MosaicTask, BundleTask, LiveTask)
