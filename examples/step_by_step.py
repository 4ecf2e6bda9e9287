"""Call the steps of the method one by one, keep what each comes to in a file, and feed the next one from it."""

import os
import tempfile
from pathlib import Path

from napari_fiberburst import (
    Bundle,
    Registration,
    calibrate,
    diagnose,
    flatten,
    refine,
    register,
    remeasure,
    render,
    sample,
    solve,
)
from napari_fiberburst.quality import motion_error, psnr
from napari_fiberburst.simulation import simulate

# The tests run every example on a burst of a few pixels.
tiny = os.environ.get("FIBERBURST_EXAMPLE_SCALE") == "tiny"
shape = (63, 72) if tiny else (256, 288)
simulated = simulate("histology", shape=shape, frames=12, pitch=6.0, physics="core")
burst, truth = simulated.burst, simulated.truth[0]
folder = Path(tempfile.mkdtemp())

# 1. The bundle, from the burst alone.
bundle = calibrate(burst)
print(bundle)

# 2. The motion, from one value a core; then the bundle again, now that the object is known.
registration = register(sample(burst, bundle))
bundle, registration = remeasure(burst, bundle, registration)

# 3. The samples by that bundle, and the motion and the gains by those samples.
samples = sample(burst, bundle)
registration = refine(samples, registration)
print(f"motion off by {motion_error(registration.reference_from_frame, simulated.homographies, shape):.3f} px")

# 4. The light, where it is not even; samples by a bundle that knows it.
bundle, registration = flatten(burst, bundle, registration)
samples = sample(burst, bundle)

# Whatever a step has come to can wait in a file: the scene may be solved elsewhere, or later.
bundle.save(folder / "probe.bundle")
registration.save(folder / "motion.safetensors")
bundle, registration = Bundle.load(folder / "probe.bundle"), Registration.load(folder / "motion.safetensors")

# 5. The scene, and what it rests on.
scene = solve(samples, registration)
image = render(burst, bundle, registration, scene, fill=True)
found = diagnose(burst, bundle, registration, scene)
print(f"captured frame {psnr(burst.frames[0], truth):.1f} dB, image {psnr(image, truth):.1f} dB")
print(f"resolution {found.resolution} px; lambda {scene.smoothness:.3g}; frames used {found.frames_used}")
