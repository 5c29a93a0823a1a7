# SPDX-License-Identifier: MIT
"""ajna.analysis against brute force and closed forms; ajna.plots draws it; the page of docs/ is renewed from it."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib import _pylab_helpers

pytest.importorskip("torchmetrics", reason="needs the eval extra")

from ajna import analysis, plots
from ajna.data.frame_pair import FramePair
from ajna.metrics import Sparsification

ROOT = Path(__file__).resolve().parents[2]
HEIGHT, WIDTH = 30, 40


def make_table(rows: int = 40_000, seed: int = 0) -> analysis.PixelTable:
    """Laplace errors whose scale is the expected error, another for each axis: as honest as can be."""
    random = np.random.default_rng(seed)
    expected = random.uniform(0.1, 3, size=(rows, 2))
    contrast = random.uniform(0.5, 20, size=(rows, 2))
    return analysis.PixelTable(
        case=np.arange(rows) % 4,
        deviation=random.laplace(scale=expected),
        expected=expected,
        uncertainty=np.sqrt(expected),
        motion=random.uniform(0, 30, size=rows),
        gradient=random.uniform(0, 50, size=rows),
        axis_contrast=contrast,
        contrast=random.uniform(0, 40, size=rows),
        boundary=random.integers(0, 24, size=rows).astype(float),
        occluded=random.uniform(size=rows) < 0.1,
    )


def make_answer(seed: int = 0) -> analysis.Answer:
    random = np.random.default_rng(seed)
    frame = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    flow = random.normal(size=(HEIGHT, WIDTH, 2)).astype(np.float32)
    valid = random.uniform(size=(HEIGHT, WIDTH)) < 0.8
    edge = np.zeros((HEIGHT, WIDTH), bool)
    edge[10:12, 5:30] = True
    pair = FramePair(f"case{seed}", frame, frame, flow, valid, random.uniform(size=valid.shape) < 0.2, edge)
    found = flow + random.normal(size=flow.shape).astype(np.float32)
    error = np.abs(found - flow) * random.uniform(0.5, 2, size=flow.shape).astype(np.float32)
    return pair, SimpleNamespace(flow=found, uncertainty=error, expected_error=error)


# --- what a pixel looks like ---------------------------------------------------------------------------------------


def test_windows_and_distances_are_those_of_a_loop() -> None:
    random = np.random.default_rng(0)
    frame = random.integers(0, 256, (12, 15, 3), dtype=np.uint8)
    luma = frame @ np.array([0.299, 0.587, 0.114])
    contrast, mean = analysis.local_contrast(frame, 5), analysis.window_mean(luma, 5)
    mask = random.uniform(size=(12, 15)) < 0.03
    mask[6, 7] = True
    distance = analysis.distance_to(mask, 6)
    marked = np.argwhere(mask)
    for y in range(12):
        for x in range(15):
            window = luma[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
            assert mean[y, x] == pytest.approx(window.mean()) and contrast[y, x] == pytest.approx(window.std())
            assert distance[y, x] == min(6, np.abs(marked - (y, x)).max(axis=1).min())
    assert not analysis.local_contrast(np.full((9, 9, 3), 77, np.uint8)).any()
    assert (analysis.distance_to(np.zeros((4, 4), bool), 6) == 6).all()


def test_gradient_of_a_ramp() -> None:
    ramp = np.repeat((3 * np.arange(20) + 2 * np.arange(10)[:, None])[..., None], 3, axis=2).astype(np.uint8)
    assert np.allclose(analysis.image_gradient(ramp), (3, 2))
    assert np.allclose(analysis.axis_contrast(ramp), (3, 2))


# --- the table -----------------------------------------------------------------------------------------------------


def test_sampled_pixels_are_those_of_the_pairs() -> None:
    answers = [make_answer(seed) for seed in range(2)]
    whole = analysis.sample_pixels(answers)
    assert len(whole) == sum(pair.valid.sum() for pair, _ in answers)
    pair, field = answers[1]
    second = whole.where(whole.case == 1)
    assert np.allclose(second.deviation, (field.flow - pair.flow)[pair.valid], atol=1e-6)
    assert np.allclose(second.expected, field.expected_error[pair.valid])
    assert np.array_equal(second.occluded, pair.occlusion[pair.valid])
    assert np.allclose(second.motion, np.linalg.norm(pair.flow, axis=2)[pair.valid])
    assert np.array_equal(second.boundary, analysis.distance_to(pair.motion_boundary)[pair.valid])
    assert np.allclose(second.error, np.linalg.norm(second.deviation, axis=1))
    few, again = (analysis.sample_pixels(iter(answers), per_pair=50, seed=3) for _ in range(2))
    assert len(few) == 100 and np.array_equal(few.deviation, again.deviation)
    even, odd = whole.halves()
    assert set(even.case) == {0} and set(odd.case) == {1}
    with pytest.raises(ValueError, match="a held-out half needs at least 2 pairs"):
        even.halves()
    with pytest.raises(ValueError, match="case 'bare' has no ground truth"):
        analysis.sample_pixels([(FramePair("bare", pair.frame1, pair.frame2), field)])
    with pytest.raises(ValueError, match="there are no pairs"):
        analysis.sample_pixels([])


def test_sparsification_is_the_metrics() -> None:
    answers = [make_answer(seed) for seed in range(3)]
    curve = analysis.sparsification(answers, lambda pair, field: np.linalg.norm(field.uncertainty, axis=2))
    metric = Sparsification()
    for pair, field in answers:
        flow, target, sigma = (
            torch.from_numpy(item).permute(2, 0, 1)[None] for item in (field.flow, pair.flow, field.uncertainty)
        )
        metric.update(flow, target, sigma, torch.from_numpy(pair.valid)[None])
    expected = metric.compute()
    assert curve.ause == pytest.approx(expected.ause.item(), abs=1e-6)
    assert np.allclose(curve.by_uncertainty, expected.by_uncertainty.numpy(), atol=1e-6)


# --- figures -------------------------------------------------------------------------------------------------------


def test_relation_bins_hold_equally_many_and_mean_what_they_hold() -> None:
    random = np.random.default_rng(0)
    x, expected, actual = random.normal(size=(3, 1200))
    curve = analysis.relation(x, expected, actual, bins=6)
    assert (curve.pixels == 200).all()
    order = np.argsort(x).reshape(6, 200)
    for found, values in zip(curve[:3], (x, expected, actual), strict=True):
        assert np.allclose(found, values[order].mean(axis=1))
    mask = x > 0.5
    by_mask = analysis.relation(np.where(np.arange(1200) < 100, np.nan, mask), expected, actual)
    assert by_mask.value.tolist() == [0, 1] and by_mask.pixels.sum() == 1100
    assert by_mask.actual[1] == pytest.approx(actual[100:][mask[100:]].mean())
    with pytest.raises(ValueError, match="known in no pixel"):
        analysis.relation(np.full(3, np.nan), np.ones(3), np.ones(3))


def test_an_honest_network_is_reliable_and_a_boasting_one_is_not() -> None:
    table = make_table()
    actual = np.abs(table.deviation[:, 0])
    honest = analysis.reliability(table.expected[:, 0], actual)
    boasting = analysis.reliability(table.expected[:, 0] / 2, actual)
    assert np.allclose(honest.actual, honest.expected, rtol=0.1)
    assert analysis.calibration_error(honest) < 0.05
    assert analysis.calibration_error(boasting) == pytest.approx(table.expected[:, 0].mean() / 2, rel=0.05)


def test_correlations_are_eq_9_and_of_ranks() -> None:
    random = np.random.default_rng(0)
    a = random.normal(size=500)
    b = a + random.normal(size=500)
    found = analysis.correlations(a, b)
    eq9 = (np.mean(a * b) - a.mean() * b.mean()) / (
        np.sqrt(np.mean(a**2) - a.mean() ** 2) * np.sqrt(np.mean(b**2) - b.mean() ** 2)
    )
    ranks = [np.argsort(np.argsort(values)) for values in (a, b)]
    assert found.pearson == pytest.approx(eq9)
    assert found.spearman == pytest.approx(np.corrcoef(*ranks)[0, 1])


def test_axes_that_know_about_themselves() -> None:
    matrix = analysis.axis_correlations(make_table())
    assert matrix.shape == (2, 2) and min(matrix[0, 0], matrix[1, 1]) > 0.3
    assert max(abs(matrix[0, 1]), abs(matrix[1, 0])) < 0.05


def test_aperture_compares_the_axes_by_texture() -> None:
    table = make_table()
    # u is seen by the derivative in x: its error falls with it, and likewise v.
    scale = 1.0 / table.axis_contrast
    table = analysis.PixelTable(
        **{**vars(table), "expected": scale, "deviation": np.random.default_rng(1).laplace(scale=scale)}
    )
    curve = analysis.aperture(table)
    assert (np.diff(curve.expected) > 0).all() and curve.expected[0] < -1 < 1 < curve.expected[-1]
    assert np.allclose(curve.actual, curve.expected, atol=0.2)
    with pytest.raises(ValueError, match="no pixel has a gradient of 1000"):
        analysis.aperture(table, min_contrast=1000)


def test_intervals_hold_on_the_other_half() -> None:
    fit, held_out = make_table(seed=1), make_table(seed=2)
    found = analysis.intervals(fit, held_out, levels=(0.5, 0.9))
    assert np.allclose(found.factor, -np.log(1 - found.level), rtol=0.03)  # of the Laplace density
    assert np.allclose(found.coverage, found.level[:, None], atol=0.01)
    assert np.allclose(found.width, 2 * found.factor * held_out.expected.mean())
    value, share = analysis.coverage_by(held_out, held_out.expected_norm, found.factor[1])
    assert (np.diff(value) > 0).all() and np.allclose(share, 0.9, atol=0.03)
    with pytest.raises(ValueError, match="must lie between 0 and 1"):
        analysis.intervals(fit, held_out, levels=(0.5, 1.0))


def test_regions_are_masks_of_the_table() -> None:
    table = make_table()
    regions = analysis.by_region(table, near=2, flat=5)
    assert regions["all"]["share"] == 1 and regions["occluded"]["share"] == table.occluded.mean()
    at_boundary = table.boundary <= 2
    assert regions["at depth boundaries"]["actual"] == pytest.approx(table.error[at_boundary].mean())
    rest = ~(table.occluded | at_boundary | (table.contrast < 5))
    assert regions["rest"]["expected"] == pytest.approx(table.expected_norm[rest].mean())


# --- pictures ------------------------------------------------------------------------------------------------------


def test_boundary_ratio_is_of_medians_over_regions() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (80, 100, 3), dtype=np.uint8)
    boundary, hidden = np.zeros((80, 100), bool), np.zeros((80, 100), bool)
    boundary[:, 50] = True
    hidden[20:60, 30:35] = True
    uncertainty = np.full((80, 100), 0.5)
    uncertainty[:, 48:53] = 2.0  # within two steps of the boundary
    uncertainty[hidden] = 2.0
    uncertainty[:8] = 100.0  # the image's border does not count
    both, jumps = (analysis.boundary_regions(frame, boundary, mask) for mask in (hidden, None))
    assert not (both[0] & both[1]).any() and not both[0][:8].any() and not both[1][:, -8:].any()
    assert analysis.boundary_ratio(both, uncertainty) == pytest.approx(4.0)
    uncertainty[hidden] = 0.5  # 200 hidden pixels against 320 at the boundary
    assert analysis.boundary_ratio(both, uncertainty) == pytest.approx(4.0)
    assert analysis.boundary_ratio(jumps, 3 * uncertainty) == pytest.approx(4.0)
    unknown = uncertainty.copy()
    unknown[10:40] = np.nan  # no ground truth there
    assert analysis.boundary_ratio(jumps, unknown) == pytest.approx(4.0)
    assert np.isnan(analysis.boundary_ratio(jumps, np.full_like(uncertainty, np.nan)))  # none anywhere
    flat = analysis.boundary_regions(np.full_like(frame, 90), boundary, hidden)
    assert np.isnan(analysis.boundary_ratio(flat, uncertainty))  # nothing is textured
    nowhere = analysis.boundary_regions(frame, np.zeros_like(boundary), None)
    assert np.isnan(analysis.boundary_ratio(nowhere, uncertainty))


def test_every_plot_is_a_picture_of_its_data() -> None:
    table = make_table(4000)
    curve = analysis.reliability(table.expected_norm, table.error)
    found = analysis.intervals(*table.halves())
    local = analysis.coverage_by(table, table.expected_norm, found.factor[-2])
    pair, field = make_answer()
    pictures = {
        "panel": plots.uncertainty_panel(pair, field, title="a title", width=640),
        "correlation": plots.correlation_plot(table),
        "reliability": plots.reliability_plot({"both": curve}),
        "relations": plots.relations_plot(
            {"expected error, px": curve}, logarithmic=("expected error, px",), columns=2
        ),
        "regions": plots.regions_plot(analysis.by_region(table)),
        "aperture": plots.aperture_plot(analysis.aperture(table)),
        "intervals": plots.intervals_plot(found, local, 0.9, title="a title"),
    }
    for name, picture in pictures.items():
        assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3, name
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20, name
    assert pictures["panel"].shape[1] == 640
    assert not np.array_equal(
        pictures["reliability"], plots.reliability_plot({"both": curve._replace(actual=curve.value * 2)})
    )
    assert not _pylab_helpers.Gcf.get_all_fig_managers(), "no figure of pyplot is left open"
    with pytest.raises(ValueError, match="case 'bare' has no ground truth"):
        plots.uncertainty_panel(FramePair("bare", pair.frame1, pair.frame2), field)


# --- the page ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    script = ROOT / "tools" / "uncertainty_page.py"
    if not script.exists():
        pytest.skip("the source tree's tools/ is not here")
    spec = importlib.util.spec_from_file_location("uncertainty_page", script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_links_what_is_there_and_keeps_numbers_in_its_tables() -> None:
    page = ROOT / "docs" / "uncertainty.md"
    if not page.exists():
        pytest.skip("the source tree's docs/ is not here")
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("http") or (page.parent / target).exists(), f"uncertainty.md names {target}"
    prose = re.sub(r"<!-- (\w+) -->.*?<!-- /\1 -->", "", text, flags=re.DOTALL)
    assert not re.search(r"\d\.\d", prose), "a measured number outside of the generated tables would go stale"
    for block in ("SYNTHETIC", "PAIRS"):
        measured = re.search(rf"<!-- {block} -->\n(.*?)<!-- /{block} -->", text, re.DOTALL)
        assert measured is not None
        if not (block == "PAIRS" and measured[1].startswith("Not measured for this model yet")):
            assert all(part in measured[1] for part in ("`ajna bench uncertainty", "this model, one pass", "SHA-256"))


def test_the_page_is_renewed_between_its_markers(
    tool: ModuleType, tiny_checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ajna.io", reason="needs the build with vision", exc_type=ImportError)
    (tmp_path / "images").mkdir()
    page = tmp_path / "uncertainty.md"
    page.write_text(
        "before\n<!-- SYNTHETIC -->\nold\n<!-- /SYNTHETIC -->\nbetween\n<!-- PAIRS -->\n<!-- /PAIRS -->\nafter\n"
    )
    options = ["--model", str(tiny_checkpoint), "--scenes", "1", "--size", "64x48", "--repeats", "1", "--no-notebook"]
    assert tool.main(["--docs", str(tmp_path), *options]) == 0
    text = page.read_text()
    assert text.startswith("before\n<!-- SYNTHETIC -->\n`ajna bench uncertainty --dataset synthetic --scenes 1")
    assert "\nold\n" not in text and "this model, one pass" in text and text.endswith("<!-- /PAIRS -->\nafter\n")
    assert sorted(path.stem for path in (tmp_path / "images").iterdir()) == [
        f"uncertainty_{n}" for n in sorted(tool.SCENES)
    ]
    with pytest.raises(ValueError, match="must hold '<!-- PAIRS -->'"):
        tool.replace_block("no markers", "PAIRS", "")
    assert tool.main(["--docs", str(tmp_path / "nowhere")]) == 2 and "does not exist" in capsys.readouterr().err
