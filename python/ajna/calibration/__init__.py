# SPDX-License-Identifier: MIT
"""Calibration on held-out images: what a model's uncertainty means in pixels, and intervals with a stated coverage.

Two things are fitted, on two disjoint parts of the images, and judged on a third part that neither has seen:

- the **expected error** as a monotone function of the raw uncertainty, by isotonic regression of the absolute error per
  axis. It becomes the ``expected_error`` curve of the checkpoint's table, so the engine, TorchScript files and the
  flight software use it without further code;
- **split-conformal factors**: the interval of an axis with share p is flow -+ factor(p) * expected_error, where
  factor(p) is the finite-sample quantile of |error| / expected_error over the calibration images. They go into the
  checkpoint's metadata; :meth:`ajna.FlowField.interval` applies them.

What holds: if the calibration images and a new image are exchangeable, the interval contains the true flow component of
a randomly chosen pixel of the new image with probability at least p, whatever the network and the distribution
(``weighting="image"``; the n images are the units, as the pixels of one image depend on each other). What does not:
coverage *in each* image, region, or at each magnitude of motion or uncertainty; coverage on images of another kind;
joint coverage of both axes or of all pixels; levels between the fitted ones, whose factors are interpolated; and any
finite-sample statement about the expected error itself. With ``weighting="pixel"`` the same would need all pixels to be
exchangeable, which they are not: its factors are averages, without a guarantee.

    result = ajna.calibration.fit("best", ajna.calibration.SyntheticScenes(400, 320, 240, seed=0))
    result.after.coverage.coverage        # on images that nothing was fitted on
    result.save("calibrated.safetensors")
    ajna.load("calibrated.safetensors")(frame1, frame2).interval(0.9)
"""

from ajna.calibration.fitting import DEFAULT_LEVELS, CalibrationResult, PairSource, fit
from ajna.calibration.held_out import HeldOut
from ajna.calibration.plot import reliability_plot
from ajna.data.synthetic import SyntheticScenes

__all__ = ["DEFAULT_LEVELS", "CalibrationResult", "HeldOut", "PairSource", "SyntheticScenes", "fit", "reliability_plot"]
