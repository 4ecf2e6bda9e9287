"""The napari plugin: a form, a worker, layers that resolve, and what is kept of each run.

Importing this package loads neither Qt nor torch; `napari.yaml` names what napari calls.
"""

# Where a sample layer carries its truth, and a result layer where it came from.
METADATA_KEY = "fiberburst"
# ... and in there, what its file says of a burst's recording: pixel size, unit, channel names and times.
RECORDING_KEY = "recording"
