# SPDX-License-Identifier: MIT
"""Flow methods to compare with: classical ones, none at all, and uncertainty from several passes.

Each is called like a model, ``method(frame1, frame2)`` with RGB uint8 [H, W, 3], and gives a :class:`BaselineField`.
The uncertainty of the classical ones is the forward-backward distance: how far a pixel ends from where it started when
it follows the flow from frame 1 to frame 2 and the flow back. :mod:`ajna.baselines.sampled` holds the others.
"""

from ajna.baselines.aligned import Aligned, AlignedField, with_aligned
from ajna.baselines.classical import (
    BASELINES,
    BaselineField,
    Cost,
    CostedMethod,
    DenseInverseSearch,
    Farneback,
    FlowMethod,
    ZeroFlow,
    forward_backward_difference,
    make_baseline,
)
from ajna.baselines.sampled import (
    SAMPLED,
    DeepEnsemble,
    FlowMoments,
    ForwardBackward,
    McDropout,
    OnePass,
    SampledField,
    SamplingOptions,
    droppable_layers,
    make_sampled,
    noise_variance,
)

__all__ = [
    "BASELINES",
    "SAMPLED",
    "Aligned",
    "AlignedField",
    "BaselineField",
    "Cost",
    "CostedMethod",
    "DeepEnsemble",
    "DenseInverseSearch",
    "Farneback",
    "FlowMethod",
    "FlowMoments",
    "ForwardBackward",
    "McDropout",
    "OnePass",
    "SampledField",
    "SamplingOptions",
    "ZeroFlow",
    "droppable_layers",
    "forward_backward_difference",
    "make_baseline",
    "make_sampled",
    "noise_variance",
    "with_aligned",
]
