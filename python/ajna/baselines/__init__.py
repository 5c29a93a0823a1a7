# SPDX-License-Identifier: MIT
"""Flow methods to compare with: classical ones, and none at all.

Each is called like a model, ``method(frame1, frame2)`` with RGB uint8 [H, W, 3], and gives a :class:`BaselineField`.
Their uncertainty is the forward-backward distance: how far a pixel ends from where it started when it follows the
flow from frame 1 to frame 2 and the flow back.
"""

from ajna.baselines.classical import (
    BASELINES,
    BaselineField,
    DenseInverseSearch,
    Farneback,
    FlowMethod,
    ZeroFlow,
    forward_backward_difference,
    make_baseline,
)

__all__ = [
    "BASELINES",
    "BaselineField",
    "DenseInverseSearch",
    "Farneback",
    "FlowMethod",
    "ZeroFlow",
    "forward_backward_difference",
    "make_baseline",
]
