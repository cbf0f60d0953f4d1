"""Tables and words follow the numbers, both ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.running.ledger import Row
from benchmarks.seed_study.contenders import CONTENDERS
from benchmarks.seed_study.summary import summary, verdicts
from benchmarks.seed_study.tables import reduction, reductions_table, table2


def rows(**means: dict[str, float]) -> list[Row]:
    rng = np.random.default_rng(1)
    found = []
    for repetition in range(20):
        noise = 1 + 0.01 * rng.standard_normal()
        for contender, metrics in means.items():
            values = {name: value * noise for name, value in metrics.items()}
            found.append(Row(f"{contender}{repetition}", "paper", "pollen", contender, repetition, values))
    return found


def test_a_reduction_is_in_percent_of_the_control_and_paired() -> None:
    found = rows(proposed={"rmse_um": 0.5}, disparity_printed={"rmse_um": 1.0})
    got = reduction(found, "proposed", "disparity_printed", "rmse_um")
    assert got.percent == pytest.approx(50)
    # the noise is common to both contenders: a paired comparison does not see it
    assert got.high - got.low < 1e-9


def test_the_interval_covers_the_true_reduction() -> None:
    rng = np.random.default_rng(3)
    covered = 0
    for trial in range(200):
        found = [
            Row(f"{trial}", "paper", "pollen", name, i, {"rmse_um": mean + 0.1 * rng.standard_normal()})
            for i in range(20)
            for name, mean in (("a", 0.9), ("b", 1.0))
        ]
        got = reduction(found, "a", "b", "rmse_um", resamples=400)
        covered += got.low <= 10 <= got.high
    assert 0.86 <= covered / 200 <= 0.99


def test_a_run_that_failed_for_one_contender_is_left_out_for_both() -> None:
    found = rows(proposed={"rmse_um": 0.5}, disparity_printed={"rmse_um": 1.0})
    worse = [r for r in found if not (r.contender == "disparity_printed" and r.repetition == 0)]
    worse.append(Row("x", "paper", "pollen", "disparity_printed", 0, {}, "too few matches"))
    assert reduction(worse, "proposed", "disparity_printed", "rmse_um").percent == pytest.approx(50)
    assert "| disparity_printed | 19 of 20 |" in table2(
        [
            Row(
                "y",
                "p",
                "s",
                r.contender,
                r.repetition,
                {**r.metrics, **({"points": 10.0} if r.metrics else {})},
                r.failure,
            )
            for r in worse
        ]
    )


@pytest.mark.parametrize(
    ("ours", "phrase"),
    [(0.5, "50.0 % lower"), (1.2, "the sign is the opposite here"), (1.0, "no such gain appears here")],
)
def test_words_follow_the_sign(ours: float, phrase: str) -> None:
    found = rows(proposed={"rmse_um": ours}, disparity_printed={"rmse_um": 1.0}, disparity_boyde={"rmse_um": 1.0})
    assert phrase in " ".join(verdicts(found, "pollen"))


def test_truth_is_said_to_be_absent_on_real_images() -> None:
    found = rows(proposed={"rmse_um": 0.5}, disparity_printed={"rmse_um": 1.0}, disparity_boyde={"rmse_um": 1.0})
    assert "There is no truth" in summary({"grain": found}, [], 60)
    found = rows(
        proposed={"rmse_um": 0.5, "depth_median_um": 0.3}, disparity_printed={"rmse_um": 0.4, "depth_median_um": 3}
    )
    text = summary({"grain": found}, [], 60)
    assert "There is no truth" not in text
    assert "RMSE ranks disparity_printed first, with 10.0 times the least depth error: agreement of clouds" in text


def test_published_figures_stand_beside_ours() -> None:
    found = rows(**{each.name: {"rmse_um": 1.0, "rre_deg": 1.0} for each in CONTENDERS})
    assert "| published, than its control | 44 % | 88 % |" in reductions_table(found, "pollen")
    assert "published" not in reductions_table(found, "other")


def test_rounding_is_not_called_spread() -> None:
    same = [
        replace(row, metrics={"rmse_um": 0.1 + 0.2, "rre_deg": 1.0}) for row in rows(proposed={}, disparity_printed={})
    ]
    assert "The runs do not differ" in " ".join(verdicts(same, "grain"))
    assert "± 0 |" in table2([replace(row, metrics={**row.metrics, "points": 9.0}) for row in same])


def test_contenders_that_are_alike_share_a_rank() -> None:
    metrics = {
        name: {"rmse_um": 1.0, "depth_median_um": depth}
        for name, depth in (("proposed", 0.5), ("disparity_boyde", 0.505))
    }
    found = rows(disparity_printed={"rmse_um": 2.0, "depth_median_um": 2.0}, **metrics)
    text = " ".join(verdicts(found, "pollen"))
    assert "Truth ranks proposed and disparity_boyde (alike) first, and so does RMSE." in text
