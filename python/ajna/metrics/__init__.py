# SPDX-License-Identifier: MIT
"""Scores of optical flow and of its uncertainty, as torchmetrics classes.

Every metric keeps only running sums (constant memory, summed over processes), takes batches of tensors and may be
mixed in a ``torchmetrics.MetricCollection`` that is fed by keyword::

    scores = MetricCollection([EndPointError(), AUSE(), Spearman(), OcclusionAUC()])
    scores.update(prediction=flow, target=truth, uncertainty=sigma, occlusion=hidden, valid=valid)

Shapes and units: ``prediction`` and ``target`` are [N, 2, H, W] in pixels; ``uncertainty`` is [N, 2, H, W] (its
2-norm over the axes is scored), [N, 1, H, W] or [N, H, W]; ``expected_error``, ``low`` and ``high`` are [N, 2, H, W]
in pixels; ``valid``, ``occlusion`` and ``motion_boundary`` are boolean [N, H, W] or [N, 1, H, W]. Pixels whose target
is not finite or beyond 1e9 in magnitude (Middlebury's "unknown") are never scored; values in unscored pixels, NaN
included, have no effect.

Three groups: errors of the flow (EndPointError, FlAll, OutlierRate); ranking, which any monotone map of the uncertainty
leaves as it is (Sparsification, AUSE, Spearman, OcclusionAUC, MotionBoundaryAUC; also Pearson, which is linear); and
calibration, which asks for pixels (Reliability, ExpectedCalibrationError, Coverage, IntervalCoverage, IntervalWidth) or
for a density (QuantileCalibration, NegativeLogLikelihood, CRPS).

Averaging: every figure is the **mean over images of a per-image figure**, so that a dense and a sparse image count the
same; curves over bins are sums in which each image has the same weight. ``average="pixel"`` pools all pixels instead,
as the KITTI benchmark does, where a metric offers it.

Degenerate cases, the same everywhere: an image without scored pixels does not count; without any counted image the
result is NaN; a NaN in a scored pixel of the prediction or the uncertainty makes the result NaN rather than hiding.
"""

from ajna.metrics.base import Average
from ajna.metrics.calibration import (
    Coverage,
    CoverageCurve,
    ExpectedCalibrationError,
    IntervalCoverage,
    IntervalWidth,
    QuantileCalibration,
    QuantileCurve,
    Reliability,
    ReliabilityCurve,
)
from ajna.metrics.errors import EndPointError, FlAll, OutlierRate
from ajna.metrics.functions import (
    UNKNOWN_FLOW,
    area_between,
    average_ranks,
    end_point_error,
    kitti_outliers,
    motion_boundaries,
    pearson_correlation,
    roc_auc,
    sparsification_curves,
    uncertainty_norm,
)
from ajna.metrics.likelihood import CRPS, NegativeLogLikelihood
from ajna.metrics.ranking import (
    AUSE,
    MotionBoundaryAUC,
    OcclusionAUC,
    Pearson,
    Sparsification,
    SparsificationCurves,
    Spearman,
)

__all__ = [
    "AUSE",
    "CRPS",
    "UNKNOWN_FLOW",
    "Average",
    "Coverage",
    "CoverageCurve",
    "EndPointError",
    "ExpectedCalibrationError",
    "FlAll",
    "IntervalCoverage",
    "IntervalWidth",
    "MotionBoundaryAUC",
    "NegativeLogLikelihood",
    "OcclusionAUC",
    "OutlierRate",
    "Pearson",
    "QuantileCalibration",
    "QuantileCurve",
    "Reliability",
    "ReliabilityCurve",
    "Sparsification",
    "SparsificationCurves",
    "Spearman",
    "area_between",
    "average_ranks",
    "end_point_error",
    "kitti_outliers",
    "motion_boundaries",
    "pearson_correlation",
    "roc_auc",
    "sparsification_curves",
    "uncertainty_norm",
]
