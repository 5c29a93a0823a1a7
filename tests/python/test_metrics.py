# SPDX-License-Identifier: MIT
"""ajna.metrics against brute-force references and closed forms that are written independently of it."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torchmetrics import MetricCollection

from ajna.metrics import (
    AUSE,
    EndPointError,
    FlAll,
    OcclusionAUC,
    OutlierRate,
    Pearson,
    Sparsification,
    Spearman,
    average_ranks,
    roc_auc,
    sparsification_curves,
)

SEEDS = range(4)


def make_batch(seed: int, images: int = 3, height: int = 7, width: int = 9) -> dict[str, torch.Tensor]:
    """A batch with ties in the uncertainty, garbage under the mask and unknown ground truth."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.randn(images, 2, height, width, generator=generator) * 30
    scale = torch.rand(images, 1, height, width, generator=generator) * 8
    prediction = target + torch.randn(images, 2, height, width, generator=generator) * scale
    uncertainty = (scale.expand(-1, 2, -1, -1) + torch.rand(images, 2, height, width, generator=generator)).round()
    valid = torch.rand(images, height, width, generator=generator) < 0.7
    occlusion = torch.rand(images, 1, height, width, generator=generator) < 0.1 + scale / 10
    hidden = ~valid[:, None].expand_as(target)
    prediction = torch.where(hidden, torch.nan, prediction)
    uncertainty = torch.where(hidden, torch.inf, uncertainty)
    target[:, 0, 0, 0] = torch.nan
    target[:, 1, 0, 1] = 1e10
    return {
        "prediction": prediction,
        "target": target,
        "uncertainty": uncertainty,
        "valid": valid,
        "occlusion": occlusion,
    }


# --- references: plain loops over scored pixels --------------------------------------------------------------------


def scored_pixels(batch: dict[str, torch.Tensor]) -> list[list[dict[str, float]]]:
    result = []
    arrays = {name: value.double().numpy() for name, value in batch.items()}
    images, _, height, width = arrays["target"].shape
    for n in range(images):
        pixels = []
        for y in range(height):
            for x in range(width):
                u, v = arrays["target"][n, :, y, x]
                if not arrays["valid"][n, y, x] or not (abs(u) < 1e9 and abs(v) < 1e9):
                    continue
                pu, pv = arrays["prediction"][n, :, y, x]
                pixels.append(
                    {
                        "error": math.hypot(pu - u, pv - v),
                        "magnitude": math.hypot(u, v),
                        "uncertainty": math.hypot(*arrays["uncertainty"][n, :, y, x]),
                    }
                )
        result.append(pixels)
    return result


def column(pixels: list[dict[str, float]], name: str) -> np.ndarray:
    return np.array([pixel[name] for pixel in pixels])


def brute_ranks(values: np.ndarray) -> np.ndarray:
    return np.array([(values < value).sum() + ((values == value).sum() + 1) / 2 for value in values])


def brute_auc(score: np.ndarray, positive: np.ndarray) -> float:
    pairs = [(p > n) + 0.5 * (p == n) for p in score[positive] for n in score[~positive]]
    return float(np.mean(pairs))


def brute_ause(uncertainty: np.ndarray, error: np.ndarray, bins: int, orders: int = 400) -> float:
    """Sort, cut, average; ties are broken at random and the area is averaged over many such orders."""
    random = np.random.default_rng(0)

    def curve(key: np.ndarray) -> list[float]:
        order = np.lexsort((random.random(len(key)), -key))  # most uncertain first
        left = [error[order][k * len(key) // bins :].mean() for k in range(bins)]
        return [value / error.mean() for value in left] + [0.0]

    areas = [np.trapezoid(np.subtract(curve(uncertainty), curve(error)), dx=1 / bins) for _ in range(orders)]
    return float(np.mean(areas))


# --- agreement with the references ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_error_metrics_equal_loops(seed: int) -> None:
    batch = make_batch(seed)
    images = scored_pixels(batch)
    inputs = (batch["prediction"], batch["target"], batch["valid"])

    def outlier(pixel: dict[str, float]) -> float:
        return float(pixel["error"] > 3 and pixel["error"] > 0.05 * pixel["magnitude"])

    for average in ("image", "pixel"):
        groups = images if average == "image" else [[pixel for image in images for pixel in image]]
        assert EndPointError(average)(*inputs).item() == pytest.approx(
            np.mean([column(group, "error").mean() for group in groups])
        )
        assert FlAll(average)(*inputs).item() == pytest.approx(
            np.mean([np.mean([outlier(pixel) for pixel in group]) for group in groups])
        )
        for threshold in (1.0, 3.0, 5.0, 0.5):
            assert OutlierRate(threshold, average)(*inputs).item() == pytest.approx(
                np.mean([(column(group, "error") > threshold).mean() for group in groups])
            )


@pytest.mark.parametrize("seed", SEEDS)
def test_correlations_equal_loops(seed: int) -> None:
    batch = make_batch(seed)
    images = scored_pixels(batch)
    inputs = (batch["prediction"], batch["target"], batch["uncertainty"], batch["valid"])
    pairs = [(column(image, "uncertainty"), column(image, "error")) for image in images]
    assert Pearson()(*inputs).item() == pytest.approx(np.mean([np.corrcoef(u, e)[0, 1] for u, e in pairs]))
    ranked = [np.corrcoef(brute_ranks(u), brute_ranks(e))[0, 1] for u, e in pairs]
    assert Spearman()(*inputs).item() == pytest.approx(np.mean(ranked))


@pytest.mark.parametrize("seed", SEEDS)
def test_occlusion_auc_equals_pair_counting(seed: int) -> None:
    batch = make_batch(seed)
    norm = batch["uncertainty"].double().norm(dim=1).numpy()
    valid, occlusion = batch["valid"].numpy(), batch["occlusion"][:, 0].numpy()
    expected = np.mean([brute_auc(n[m], o[m]) for n, m, o in zip(norm, valid, occlusion, strict=True)])
    result = OcclusionAUC()(batch["uncertainty"], batch["occlusion"], batch["valid"])
    assert result.item() == pytest.approx(expected)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("bins", [2, 7, 50])
def test_ause_equals_sorting_with_random_ties(seed: int, bins: int) -> None:
    batch = make_batch(seed, images=1)
    (image,) = scored_pixels(batch)
    result = AUSE(bins)(batch["prediction"], batch["target"], batch["uncertainty"], batch["valid"])
    expected = brute_ause(column(image, "uncertainty"), column(image, "error"), bins)
    assert result.item() == pytest.approx(expected, abs=0.02)  # the reference is a Monte Carlo mean over ties


@pytest.mark.parametrize("seed", SEEDS)
def test_ause_without_ties_is_exact_and_invariant_to_monotone_maps(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    error = torch.rand(500, generator=generator, dtype=torch.float64)
    uncertainty = torch.randperm(500, generator=generator).double()
    curves = sparsification_curves(uncertainty, error)
    expected = brute_ause(uncertainty.numpy(), error.numpy(), 50, orders=1)
    assert torch.trapezoid(curves[0] - curves[1], dx=1 / 50).item() == pytest.approx(expected, abs=1e-12)
    warped = sparsification_curves(torch.expm1(uncertainty / 100), 7 * error)
    assert torch.equal(warped[0], curves[0]) or torch.allclose(warped[0], curves[0], atol=1e-12)


def test_uniform_error_has_the_closed_form() -> None:
    # Errors 1/M..1 sorted by themselves: the oracle keeps the lowest fraction q, whose mean is q/2 of a mean of 1/2.
    error = torch.arange(1, 100_001, dtype=torch.float64) / 100_000
    by_uncertainty, oracle = sparsification_curves(-error, error)
    removed = torch.arange(51, dtype=torch.float64) / 50
    assert torch.allclose(oracle, 1 - removed, atol=1e-4)
    assert torch.allclose(by_uncertainty[:-1], (1 + removed)[:-1], atol=1e-4)  # the worst order keeps the worst


def test_perfect_order_scores_perfectly() -> None:
    batch = make_batch(1)
    error = (batch["prediction"] - batch["target"]).double().norm(dim=1)
    inputs = (batch["prediction"], batch["target"], error * 2 + 1, batch["valid"])
    assert AUSE()(*inputs).item() == pytest.approx(0, abs=1e-12)
    assert Spearman()(*inputs).item() == pytest.approx(1)
    assert Pearson()(*inputs).item() == pytest.approx(1)


@pytest.mark.parametrize("seed", SEEDS)
def test_rank_identities(seed: int) -> None:
    values = torch.randint(0, 6, (40,), generator=torch.Generator().manual_seed(seed)).double()
    assert np.allclose(average_ranks(values).numpy(), brute_ranks(values.numpy()))
    positive = values + torch.randn(40, generator=torch.Generator().manual_seed(seed)) > 3
    # Swapping the classes or the sign mirrors the area about one half.
    area = roc_auc(values, positive).item()
    assert roc_auc(values, ~positive).item() == pytest.approx(1 - area)
    assert roc_auc(-values, positive).item() == pytest.approx(1 - area)


def test_known_outliers_of_kitti() -> None:
    # (error, magnitude): over 3 px and 5 %; over 3 px only; over 5 % only; exactly 3 px.
    target = torch.tensor([[10.0, 100.0, 10.0, 0.0], [0.0, 0.0, 0.0, 0.0]]).reshape(1, 2, 1, 4)
    prediction = target + torch.tensor([[4.0, 4.0, 2.0, 3.0], [0.0] * 4]).reshape(1, 2, 1, 4)
    assert FlAll()(prediction, target).item() == pytest.approx(0.25)
    assert OutlierRate(3.0)(prediction, target).item() == pytest.approx(0.5)
    assert EndPointError()(prediction, target).item() == pytest.approx(13 / 4)


# --- degenerate cases, as documented -------------------------------------------------------------------------------


def all_metrics() -> list:
    return [EndPointError(), FlAll(), OutlierRate(1.0), AUSE(), Spearman(), Pearson(), OcclusionAUC()]


@pytest.mark.parametrize("metric", all_metrics(), ids=lambda metric: type(metric).__name__)
def test_images_without_scored_pixels_do_not_count(metric) -> None:
    batch = make_batch(0)
    names = metric._filter_kwargs(**batch)
    with_empty = {name: torch.cat([value, value[:1]]) for name, value in names.items()}
    with_empty["valid"][-1] = False
    expected = metric(**names)
    metric.reset()
    assert torch.equal(metric(**with_empty), expected)
    metric.reset()
    nothing = {**names, "valid": torch.zeros_like(names["valid"])}
    assert metric(**nothing).isnan()


@pytest.mark.filterwarnings("ignore:The ``compute`` method")
def test_before_any_update_the_result_is_nan() -> None:
    assert all(metric.compute().isnan() for metric in all_metrics())


def test_constant_uncertainty_tells_nothing() -> None:
    batch = make_batch(2)
    constant = torch.full_like(batch["uncertainty"], 0.3)
    inputs = (batch["prediction"], batch["target"], constant, batch["valid"])
    curves = Sparsification()(*inputs)
    assert torch.allclose(curves.by_uncertainty[:-1], torch.ones(50, dtype=torch.float64))
    assert curves.by_uncertainty[-1] == curves.oracle[-1] == 0
    assert curves.ause.item() == pytest.approx((1 - curves.oracle[:-1]).sum().item() / 50)
    assert Spearman()(*inputs).item() == 0 and Pearson()(*inputs).item() == 0
    assert OcclusionAUC()(constant, batch["occlusion"], batch["valid"]).item() == pytest.approx(0.5)


def test_zero_error() -> None:
    batch = make_batch(3)
    inputs = (batch["target"], batch["target"], batch["uncertainty"], batch["valid"])
    assert EndPointError()(*inputs[:2], batch["valid"]).item() == 0
    assert AUSE()(*inputs).item() == 0
    assert Spearman()(*inputs).isnan() and Pearson()(*inputs).isnan()


def test_a_nan_in_a_scored_pixel_is_not_hidden() -> None:
    batch = make_batch(0)
    y, x = batch["valid"][0].nonzero()[-1].tolist()
    for name, metrics in {
        "prediction": [EndPointError(), FlAll(), OutlierRate(1.0), AUSE(), Spearman(), Pearson()],
        "uncertainty": [AUSE(), Spearman(), Pearson(), OcclusionAUC()],
    }.items():
        spoilt = {**batch, name: batch[name].clone()}
        spoilt[name][0, 0, y, x] = torch.nan
        for metric in metrics:
            assert metric(**metric._filter_kwargs(**spoilt)).isnan(), (name, metric)


def test_one_class_masks_are_not_counted() -> None:
    batch = make_batch(0)
    occlusion = batch["occlusion"].clone()
    occlusion[0] = True
    expected = OcclusionAUC()(batch["uncertainty"][1:], occlusion[1:], batch["valid"][1:])
    assert torch.equal(OcclusionAUC()(batch["uncertainty"], occlusion, batch["valid"]), expected)


# --- torchmetrics: states, collections, processes ------------------------------------------------------------------


def test_memory_is_flat_and_updates_add_up() -> None:
    batch = make_batch(5, images=4)
    for metric in all_metrics():
        names = metric._filter_kwargs(**batch)
        sizes = [state.numel() for state in metric.metric_state.values()]
        for n in range(4):
            metric.update(**{name: value[n : n + 1] for name, value in names.items()})
        assert [state.numel() for state in metric.metric_state.values()] == sizes
        together = pickle.loads(pickle.dumps(metric))
        together.reset()
        assert torch.allclose(metric.compute(), together(**names))


def test_collections_do_not_mix_metrics_that_start_equal() -> None:
    # torchmetrics shares the state of metrics whose states have the same names and values after the first batch;
    # after a perfect first batch all sums are 0, so that the names must differ.
    collection = MetricCollection(
        {
            "epe": EndPointError(),
            "fl": FlAll(),
            "out1": OutlierRate(1.0),
            "out5": OutlierRate(5.0),
            "pooled": EndPointError("pixel"),
            "ause": AUSE(),
            "rho": Spearman(),
            "auc": OcclusionAUC(),
        }
    )
    batch = make_batch(6)
    collection.update(**{**batch, "prediction": batch["target"]})
    collection.update(**batch)
    result = collection.compute()
    assert result["out1"] > result["out5"] > 0
    assert result["epe"] == pytest.approx(EndPointError()(batch["prediction"], batch["target"], batch["valid"]) / 2)


def _worker(rank: int, folder: str) -> None:
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    batch = make_batch(7, images=4)
    share = {name: value[rank * 3 : rank * 3 + 3] for name, value in batch.items()}  # 3 images and 1
    results = {}
    for metric in [*all_metrics(), Sparsification()]:
        metric.update(**metric._filter_kwargs(**share))
        value = metric.compute()
        results[type(metric).__name__] = value if isinstance(value, torch.Tensor) else value.oracle
    torch.save(results, f"{folder}/rank{rank}.pt")
    torch.distributed.destroy_process_group()


def test_two_processes_agree_with_one(tmp_path: Path) -> None:
    # By command line: a test module need not be importable by its name, which multiprocessing would ask for.
    workers = [subprocess.Popen([sys.executable, __file__, str(rank), str(tmp_path)]) for rank in range(2)]
    assert [worker.wait(timeout=300) for worker in workers] == [0, 0]
    batch = make_batch(7, images=4)
    for rank in range(2):
        results = torch.load(tmp_path / f"rank{rank}.pt", weights_only=True)
        for metric in [*all_metrics(), Sparsification()]:
            value = metric(**metric._filter_kwargs(**batch))
            value = value if isinstance(value, torch.Tensor) else value.oracle
            assert torch.allclose(results[type(metric).__name__], value), type(metric).__name__


# --- errors --------------------------------------------------------------------------------------------------------


def test_wrong_shapes_and_arguments_are_named() -> None:
    flow = torch.zeros(1, 2, 4, 5)
    with pytest.raises(ValueError, match=r"\(1, 3, 4, 5\).*must both be \[N, 2, H, W\]"):
        EndPointError()(torch.zeros(1, 3, 4, 5), flow)
    with pytest.raises(ValueError, match=r"valid has shape \(1, 5, 4\)"):
        EndPointError()(flow, flow, torch.ones(1, 5, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"uncertainty has shape \(1, 4, 4, 5\)"):
        AUSE()(flow, flow, torch.zeros(1, 4, 4, 5))
    with pytest.raises(ValueError, match="average='mean'"):
        EndPointError("mean")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="threshold_px=-1"):
        OutlierRate(-1)
    with pytest.raises(ValueError, match="bins=1"):
        AUSE(1)


if __name__ == "__main__":
    _worker(int(sys.argv[1]), sys.argv[2])
