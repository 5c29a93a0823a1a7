# SPDX-License-Identifier: MIT
"""The metrics of calibration, densities and boundaries against loops, closed forms, and over two processes."""

from __future__ import annotations

import math
import pickle
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torchmetrics import MetricCollection

from ajna.losses import UncertaintyLoss, preset
from ajna.metrics import (
    AUSE,
    CRPS,
    Coverage,
    EndPointError,
    ExpectedCalibrationError,
    IntervalCoverage,
    IntervalWidth,
    MotionBoundaryAUC,
    NegativeLogLikelihood,
    OcclusionAUC,
    QuantileCalibration,
    Reliability,
    Sparsification,
    motion_boundaries,
)

SEEDS = range(3)
LEVELS, FACTORS = (0.5, 0.9), ((0.6, 0.8), (2.0, 2.5))


def make_batch(seed: int, images: int = 3, height: int = 7, width: int = 9) -> dict[str, torch.Tensor]:
    """A batch with garbage under the mask, unknown ground truth, and errors whose mean is about expected_error."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    expected = torch.rand(images, 2, height, width, generator=generator) * 4
    target = normal(images, 2, height, width) * 20
    prediction = target + expected * 1.2 * normal(images, 2, height, width)
    valid = torch.rand(images, height, width, generator=generator) < 0.7
    hidden = ~valid[:, None].expand_as(target)
    boundary = torch.rand(images, 1, height, width, generator=generator) < 0.2
    batch = {
        "prediction": torch.where(hidden, torch.nan, prediction),
        "target": target,
        "uncertainty": torch.where(hidden, torch.inf, expected),
        "expected_error": torch.where(hidden, torch.nan, expected),
        "low": prediction - expected,
        "high": torch.where(hidden, torch.nan, prediction + expected),
        "raw": torch.where(hidden, torch.nan, normal(images, 2, height, width)),
        "cdf": torch.where(hidden, torch.nan, torch.rand(images, 2, height, width, generator=generator)),
        "motion_boundary": boundary,
        "valid": valid,
    }
    batch["target"][:, 0, 0, 0] = torch.nan
    return batch


def image_pixels(batch: dict[str, torch.Tensor], *names: str) -> list[list[np.ndarray]]:
    """Per image the scored pixels of each map, [2, M] float64."""
    result = []
    for n, valid in enumerate(batch["valid"]):
        chosen = valid & (batch["target"][n].abs() <= 1e9).all(dim=0)
        result.append([batch[name][n][:, chosen].double().numpy() for name in names])
    return result


def all_metrics() -> list:
    return [
        ExpectedCalibrationError(),
        Reliability(bins=5),
        Coverage(LEVELS, FACTORS),
        IntervalCoverage(),
        IntervalWidth(),
        MotionBoundaryAUC(),
        QuantileCalibration(),
        NegativeLogLikelihood(preset("poggi2020")),
        CRPS(preset("bhatt2021")),
        AUSE(of="fl"),
    ]


def scalar(value: object) -> torch.Tensor:
    """One number of a result: curves are judged by their summary."""
    if isinstance(value, torch.Tensor):
        return value
    return value.ece if hasattr(value, "ece") else value.error  # type: ignore[attr-defined]


# --- agreement with loops ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("average", ["image", "pixel"])
def test_reliability_equals_loops(seed: int, average: str) -> None:
    batch = make_batch(seed)
    inputs = [batch[name] for name in ("prediction", "target", "expected_error", "valid")]
    curve = Reliability(bins=4, low_px=0.5, high_px=3.0, average=average)(*inputs)
    edges = [0.0, *(0.5 * 6 ** (k / 4) for k in range(5)), math.inf]
    assert curve.edges.tolist() == pytest.approx(edges)
    weight, expected, observed = np.zeros(6), np.zeros(6), np.zeros(6)
    for prediction, target, error in image_pixels(batch, "prediction", "target", "expected_error"):
        share = 1 / error.size if average == "image" else 1.0
        for e, o in zip(error.ravel(), np.abs(prediction - target).ravel(), strict=True):
            (place,) = [k for k in range(6) if edges[k] < e <= edges[k + 1]]
            weight[place] += share
            expected[place] += share * e
            observed[place] += share * o
    gap = np.abs(observed - expected)
    assert curve.weight.numpy() == pytest.approx(weight / weight.sum())
    assert curve.expected.numpy() == pytest.approx(expected / weight)
    assert curve.observed.numpy() == pytest.approx(observed / weight)
    assert curve.ece.item() == pytest.approx(gap.sum() / weight.sum())
    assert curve.ence.item() == pytest.approx((gap / (expected / weight)).sum() / weight.sum())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("average", ["image", "pixel"])
def test_coverage_and_width_equal_loops(seed: int, average: str) -> None:
    batch = make_batch(seed)
    inputs = [batch[name] for name in ("prediction", "target", "expected_error", "valid")]
    curve = Coverage(LEVELS, FACTORS, average)(*inputs)
    for k, factors in enumerate(FACTORS):
        inside, width = [], []
        for prediction, target, error in image_pixels(batch, "prediction", "target", "expected_error"):
            reach = np.array(factors)[:, None] * error
            inside.append((np.abs(prediction - target) <= reach).ravel())
            width.append(2 * reach.ravel())
        join = np.concatenate if average == "pixel" else (lambda parts: [part.mean() for part in parts])
        assert curve.coverage[k].item() == pytest.approx(np.mean(join(inside)))
        assert curve.width[k].item() == pytest.approx(np.mean(join(width)))
    assert curve.error.item() == pytest.approx(np.abs(curve.coverage.numpy() - LEVELS).mean())
    ends = image_pixels(batch, "target", "low", "high")
    given = [batch[name] for name in ("target", "low", "high", "valid")]
    expected = np.mean([((low <= truth) & (truth <= high)).mean() for truth, low, high in ends])
    assert IntervalCoverage()(*given).item() == pytest.approx(expected)
    assert IntervalWidth()(*given).item() == pytest.approx(np.mean([(high - low).mean() for _, low, high in ends]))


@pytest.mark.parametrize("name", ["poggi2020", "bhatt2021", "martinbrualla2021"])
def test_densities_are_those_of_torch(name: str) -> None:
    batch = make_batch(4)
    loss = preset(name)
    raw = batch["raw"][:, :1] if name == "martinbrualla2021" else batch["raw"]
    inputs = {**{key: batch[key] for key in ("prediction", "target", "valid")}, "raw": raw}
    family = torch.distributions.Laplace if name == "poggi2020" else torch.distributions.Normal
    scale = loss.likelihood(2).scale(raw.double())
    prediction, target = batch["prediction"].double(), batch["target"].double()
    chosen = batch["valid"] & (batch["target"].abs() <= 1e9).all(dim=1)
    values = -family(prediction, scale, validate_args=False).log_prob(target.nan_to_num())
    if name == "martinbrualla2021":
        values = values.sum(dim=1, keepdim=True)
    expected = torch.stack([image[:, mask].mean() for image, mask in zip(values, chosen, strict=True)]).mean()
    assert NegativeLogLikelihood(loss)(**inputs).item() == pytest.approx(expected.item())
    # CRPS = E|X - y| - E|X - X'| / 2, by quantiles of X.
    shares = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    scores = []
    for n, mask in enumerate(chosen):
        error = (target[n] - prediction[n])[:, mask].flatten()
        width = scale[n].expand(2, -1, -1)[:, mask].flatten()
        unit = family(0.0, 1.0).icdf(shares).double()
        first = (width[:, None] * unit - error[:, None]).abs().mean(dim=1)
        spread = 2 * ((2 * shares - 1) * unit).mean() * width  # E|X - X'| = 4 cov(X, F(X))
        scores.append((first - spread / 2).mean())
    assert CRPS(loss)(**inputs).item() == pytest.approx(torch.stack(scores).mean().item(), rel=2e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_quantile_calibration_equals_counting(seed: int) -> None:
    batch = make_batch(seed)
    batch["cdf"][:, :, 1, 1] = 0.5  # exactly at a level
    curve = QuantileCalibration((0.25, 0.5, 0.9))(batch["cdf"], batch["valid"])
    for k, level in enumerate((0.25, 0.5, 0.9)):
        shares = [(batch["cdf"][n][:, mask] <= level).double().mean().item() for n, mask in enumerate(batch["valid"])]
        assert curve.observed[k].item() == pytest.approx(np.mean(shares))


def test_calibrated_models_score_zero() -> None:
    torch.manual_seed(0)
    expected = torch.rand(4, 2, 200, 200) * 5 + 0.1
    sign = torch.randn_like(expected).sign()
    error = torch.distributions.Laplace(0.0, 1.0).sample(expected.shape) * expected
    assert ExpectedCalibrationError()(sign * expected, torch.zeros_like(expected), expected).item() < 1e-6
    assert ExpectedCalibrationError()(error, torch.zeros_like(error), expected).item() < 0.05
    assert ExpectedCalibrationError()(2 * error, torch.zeros_like(error), expected).item() > 2
    levels = (0.5, 0.8, 0.95)
    factors = [(-math.log1p(-p),) * 2 for p in levels]
    assert Coverage(levels, factors)(error, torch.zeros_like(error), expected).error.item() < 0.005
    loss = preset("poggi2020")
    raw = torch.log(torch.expm1(expected))  # its scale is softplus(raw)
    assert QuantileCalibration()(loss.cdf(error, raw)).error.item() < 0.005


def test_sparsification_of_outliers() -> None:
    # 10 % outliers, found first: nothing is left of them after 10 % are removed. Without order the share stays.
    error = torch.full((1, 1, 100), 1.0)
    error[..., :10] = 50.0
    target = torch.zeros(1, 2, 1, 100)
    prediction = torch.stack([error, torch.zeros_like(error)], dim=1)
    curves = Sparsification(of="fl")(prediction, target, error)
    assert curves.by_uncertainty[0] == 1 and curves.by_uncertainty[5:].abs().max() == 0 and curves.ause == 0
    constant = Sparsification(of="fl")(prediction, target, torch.ones_like(error))
    assert torch.allclose(constant.by_uncertainty[:-1], torch.ones(50, dtype=torch.float64))
    assert AUSE(of="fl")(target, target, error).item() == 0
    assert AUSE(of="epe")(prediction, target, error).item() == pytest.approx(0)


def test_motion_boundaries_of_known_flow() -> None:
    flow = torch.zeros(1, 2, 5, 6)
    flow[0, 0, :, 3:] = 2.0
    expected = torch.zeros(1, 5, 6, dtype=torch.bool)
    expected[..., 2:4] = True
    assert torch.equal(motion_boundaries(flow), expected)
    assert not motion_boundaries(flow, min_jump_px=2.0).any()
    assert torch.equal(motion_boundaries(flow.transpose(2, 3)), expected.transpose(1, 2))
    valid = torch.ones(1, 5, 6, dtype=torch.bool)
    valid[0, 0, 2] = False
    expected[0, 0, 2:4] = False
    assert torch.equal(motion_boundaries(flow, valid), expected)
    flow[0, 1, 0, 2] = torch.nan
    assert torch.equal(motion_boundaries(flow), expected)


def test_motion_boundary_auc_is_the_occlusion_auc_of_another_mask() -> None:
    batch = make_batch(1)
    inputs = (batch["uncertainty"], batch["motion_boundary"], batch["valid"])
    assert torch.equal(MotionBoundaryAUC()(*inputs), OcclusionAUC()(*inputs))


# --- degenerate cases, as documented -------------------------------------------------------------------------------


@pytest.mark.parametrize("metric", all_metrics(), ids=lambda metric: type(metric).__name__)
def test_images_without_scored_pixels_do_not_count(metric) -> None:
    names = metric._filter_kwargs(**make_batch(0))
    with_empty = {name: torch.cat([value, value[:1]]) for name, value in names.items()}
    with_empty["valid"][-1] = False
    expected = scalar(metric(**names))
    assert not expected.isnan()
    metric.reset()
    assert torch.equal(scalar(metric(**with_empty)), expected)
    metric.reset()
    assert scalar(metric(**{**names, "valid": torch.zeros_like(names["valid"])})).isnan()


def test_a_nan_in_a_scored_pixel_is_not_hidden() -> None:
    batch = make_batch(0)
    y, x = batch["valid"][0].nonzero()[-1].tolist()
    for metric in all_metrics():
        for name in metric._filter_kwargs(**batch).keys() - {"target", "valid", "motion_boundary"}:
            spoilt = {**batch, name: batch[name].clone()}
            spoilt[name][0, 0, y, x] = torch.nan
            metric.reset()
            assert scalar(metric(**metric._filter_kwargs(**spoilt))).isnan(), (name, metric)


def test_nothing_expected_and_nothing_observed_is_calibrated() -> None:
    zero = torch.zeros(1, 2, 4, 5)
    curve = Reliability()(zero, zero, zero)
    assert curve.ece.item() == 0 and curve.ence.item() == 0 and curve.observed[1:].isnan().all()
    assert Coverage((0.5,), ((1.0, 1.0),))(zero, zero, zero).coverage.item() == 1


# --- torchmetrics: states, memory, processes -----------------------------------------------------------------------


def test_updates_add_up_and_collections_do_not_mix() -> None:
    batch = make_batch(5, images=4)
    for metric in all_metrics():
        names = metric._filter_kwargs(**batch)
        for n in range(4):
            metric.update(**{name: value[n : n + 1] for name, value in names.items()})
        together = pickle.loads(pickle.dumps(metric))
        together.reset()
        assert torch.allclose(scalar(metric.compute()), scalar(together(**names))), type(metric).__name__
    collection = MetricCollection(
        {
            "narrow": Coverage(LEVELS, ((0.1, 0.1), (0.2, 0.2))),
            "wide": Coverage(LEVELS, ((5.0, 5.0), (9.0, 9.0))),
            "coverage": IntervalCoverage(),
            "fl": AUSE(of="fl"),
            "epe": AUSE(),
        }
    )
    perfect = {**batch, "prediction": batch["target"], "low": batch["target"], "high": batch["target"]}
    for content in (perfect, batch):
        collection.update(**{name: content[name] for name in content if name not in ("raw", "cdf", "motion_boundary")})
    result = collection.compute()
    assert result["wide"].coverage[1] > result["narrow"].coverage[1] and result["fl"] != result["epe"]


def test_memory_is_flat_over_ten_thousand_frames() -> None:
    metrics = [EndPointError(), Reliability(), Coverage(LEVELS, FACTORS)]  # the others keep sums in the same way
    batch = make_batch(6, images=100, height=12, width=12)
    frames = 0

    def feed(count: int) -> list[int]:
        nonlocal frames
        for _ in range(count // 100):
            # New storage each time: a metric that kept its inputs would keep 12 kB per frame.
            fresh = {name: value.clone() for name, value in batch.items()}
            for metric in metrics:
                metric.update(**metric._filter_kwargs(**fresh))
            frames += 100
        return [len(pickle.dumps(metric)) for metric in metrics]

    first_sizes = feed(1000)
    first_peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert feed(9000) == first_sizes and frames == 10_000
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - first_peak) / 1024
    assert grown_mb < 25  # all frames would be 100 MB


def _worker(rank: int, folder: str) -> None:
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    batch = make_batch(7, images=4)
    share = {name: value[rank * 3 : rank * 3 + 3] for name, value in batch.items()}  # 3 images and 1
    results = []
    for metric in all_metrics():
        metric.update(**metric._filter_kwargs(**share))
        results.append(scalar(metric.compute()))
    torch.save(results, f"{folder}/rank{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_processes_agree_with_one(tmp_path: Path) -> None:
    workers = [subprocess.Popen([sys.executable, __file__, str(rank), str(tmp_path)]) for rank in range(2)]
    assert [worker.wait(timeout=300) for worker in workers] == [0, 0]
    batch = make_batch(7, images=4)
    for rank in range(2):
        results = torch.load(tmp_path / f"rank{rank}.pt", weights_only=True)
        for metric, result in zip(all_metrics(), results, strict=True):
            assert torch.allclose(result, scalar(metric(**metric._filter_kwargs(**batch)))), type(metric).__name__


# --- errors --------------------------------------------------------------------------------------------------------


def test_wrong_arguments_are_named() -> None:
    flow = torch.zeros(1, 2, 4, 5)
    with pytest.raises(ValueError, match=r"expected_error has shape \(1, 1, 4, 5\)"):
        Reliability()(flow, flow, flow[:, :1])
    with pytest.raises(ValueError, match=r"high has shape"):
        IntervalWidth()(flow, flow, flow[:, :1])
    with pytest.raises(ValueError, match="bins=0"):
        Reliability(bins=0)
    for levels in ((), (0.9, 0.5), (0.0,), (1.0,)):
        with pytest.raises(ValueError, match="strictly rising shares"):
            QuantileCalibration(levels)
    with pytest.raises(ValueError, match="1 factors for 2 levels"):
        Coverage((0.5, 0.9), ((1.0, 1.0),))
    with pytest.raises(ValueError, match="of='f1' is unknown"):
        AUSE(of="f1")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not the likelihood"):
        NegativeLogLikelihood(UncertaintyLoss())
    with pytest.raises(ValueError, match="CRPS of the angular von Mises-Fisher"):
        CRPS(preset("bae2021"))
    with pytest.raises(ValueError, match=r"must both be \[N, C, H, W\]"):
        NegativeLogLikelihood(preset("poggi2020"))(flow, flow, flow[:, :1])


if __name__ == "__main__":
    _worker(int(sys.argv[1]), sys.argv[2])
