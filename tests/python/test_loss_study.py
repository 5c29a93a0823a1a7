# SPDX-License-Identifier: MIT
"""The loss study: small networks whose uncertainty means their error, and misprints that end where predicted."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from ajna.cli import main
from ajna.losses import preset
from ajna.studies import loss_anatomy, loss_study, printed_forms, regression, report
from ajna.studies.loss_study import Cell, StudyOptions

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def small() -> report.Study:
    """Two presets under two kinds of noise, and the printed forms under one."""
    options = StudyOptions(presets=["ajna2023", "poggi2020"], noises=["gaussian", "skewed"], steps=800, draws=20_000)
    forms = printed_forms.PrintedOptions(noises=["gaussian"], scales=6, steps=500, lr=0.08, draws=5000)
    return report.Study(loss_study.run(options), printed_forms.run(forms), 0, options.steps, 1.0)


def test_noise_has_mean_0_and_variance_1() -> None:
    generator = torch.Generator().manual_seed(3)
    for name, draw in regression.NOISES.items():
        samples = draw((400_000,), generator).double()
        assert samples.mean().item() == pytest.approx(0.0, abs=0.01), name
        assert samples.var().item() == pytest.approx(1.0, rel=0.03), name
    skewed = regression.NOISES["skewed"]((400_000,), generator)
    assert skewed.pow(3).mean().item() == pytest.approx(math.sqrt(2.0), rel=0.1)


def test_uncertainty_means_the_error(small: report.Study) -> None:
    assert {(cell.presets[0], cell.noise) for cell in small.cells} == {
        (name, noise) for name in ("ajna2023", "poggi2020") for noise in ("gaussian", "skewed")
    }
    for cell in small.cells:
        assert cell.rho > loss_study.MIN_RHO, (cell.presets, cell.noise)
        # Few steps: the full study demands 10 % everywhere.
        assert cell.mean_deviation < loss_study.MAX_DEVIATION, (cell.presets, cell.noise, cell.mean_deviation)
    # An untrained network does not pass: the claim can fail.
    untrained = loss_study.run(StudyOptions(presets=["ajna2023"], noises=["gaussian"], steps=5, draws=1000))
    assert not untrained[0].holds and untrained[0].mean_deviation > loss_study.MAX_DEVIATION


def test_misprints_end_where_predicted(small: report.Study) -> None:
    results = {(result.preset, result.start): result for result in small.printed}
    assert {name for name, _ in results} == set(printed_forms.inadmissible_presets())
    for result in small.printed:
        assert result.holds, (result.preset, result.start, result.sentence(), result.outcome())
    for start in printed_forms.STARTS:
        for name in ("zhou2017_printed", "feng2019_printed"):
            assert results[name, start].leaves.all() and not results[name, start].stays.any()
        assert results["bae2021_printed", start].repels
    # a^2 in the exponent: with a start above 0 large errors still find a minimum, small ones do not.
    assert results["singh2021_printed", 0.0].leaves.all()
    above = results["singh2021_printed", 3.0]
    assert above.leaves.any() and above.stays.any()
    assert above.attainable[above.leaves].max() < above.attainable[above.stays].min()


def test_downhill_finds_the_stationary_point() -> None:
    loss, errors = preset("ajna2023"), torch.tensor([0.2, 1.0, 5.0])
    for start in (-4.0, 0.0, 9.0):
        ends = printed_forms.downhill(loss, errors, start)
        assert torch.allclose(loss.expected_error(ends), errors.double(), rtol=0.05)


def test_pages_and_pictures(small: report.Study) -> None:
    text = report.markdown(small, "images/x.png")
    for word in ("`poggi2020`, `li2021`" if "li2021" in text else "`poggi2020`", "singh2021_printed", "images/x.png"):
        assert word in text
    assert "as predicted" in text and "not as predicted" not in text
    picture = report.draw(small)
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and picture.std() > 10
    for image in (
        loss_anatomy.draw_curves(["ajna2023", "kendall2017"]),
        loss_anatomy.draw_printed(["singh2021_printed"]),
        loss_anatomy.draw_minimum("ajna2023", [0.5, 2.0]),
    ):
        assert image.dtype == np.uint8 and image.std() > 10


def test_presets_with_the_same_terms_are_trained_once() -> None:
    groups = loss_study.same_loss(loss_study.admissible_presets())
    assert sum(map(len, groups)) == 18 and ["poggi2020", "li2021"] in groups
    with pytest.raises(ValueError, match="did you mean 'gaussian'"):
        StudyOptions(noises=["gausian"])
    with pytest.raises(ValueError, match="grid = 1"):
        StudyOptions(grid=1)


def test_the_command_fails_where_a_claim_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, small: report.Study
) -> None:
    seen: list[StudyOptions] = []

    def cells(options: StudyOptions, progress: object) -> list[Cell]:
        seen.append(options)
        return small.cells[:1]

    monkeypatch.setattr(loss_study, "run", cells)
    monkeypatch.setattr(printed_forms, "run", lambda options, progress: small.printed)
    monkeypatch.setattr(loss_study, "MAX_DEVIATION", 1.0)
    assert main(["study", "loss", "--out", str(tmp_path / "out"), "--json", "--seed", "4"]) == 0
    assert seen[0].seed == 4
    record = json.loads(capsys.readouterr().out)
    assert record["holds"] and record == json.loads((tmp_path / "out" / "loss_study.json").read_text())
    assert "loss_study.png" in (tmp_path / "out" / "loss_study.md").read_text()
    assert (tmp_path / "out" / "images" / "loss_study.png").stat().st_size > 1000
    monkeypatch.setattr(loss_study, "MAX_DEVIATION", 1e-6)
    assert main(["study", "loss"]) == 1
    assert "claims that fail: 1" in capsys.readouterr().out
    (tmp_path / "file").write_text("")
    assert main(["study", "loss", "--out", str(tmp_path / "file")]) == 2
    assert "is a file" in capsys.readouterr().err
