"""The paper's tables agree with each other, and the claims with the tables they quote."""

from itertools import pairwise

import pytest

from flexroad.pipeline.config.loading import load_config
from flexroad.tools.report.content import FIGURES
from flexroad.tools.reproduce.published import CLAIMS, GEROD, TABLE_I, TABLE_II, published

TEXT_AND_TABLE_DIFFER = {"Sampling at 0.5 m / 5 m doubles the triangles (four times in Table II)"}


def test_ablation_config_has_all_rows_of_the_tables():
    assert len(TABLE_II) == 19
    names = [row.variant for row in (*TABLE_I[:2], *TABLE_II)]
    assert names == list(load_config("ablation").chains)


def test_full_pipeline_row_matches_table_i():
    main, full = TABLE_I[-1], TABLE_II[0]
    for figure in FIGURES:
        # Table I rounds triangles to thousands.
        assert main.value(figure) == pytest.approx(full.value(figure), rel=0.02)
    assert published("flexroad") == full


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.text)
def test_claim_matches_the_papers_tables(claim):
    values = [published(name, claim.dataset).value(claim.figure) for name in claim.variants]
    if claim.quoted is None:
        assert all(a <= b for a, b in pairwise(values))
        return
    base, changed = values
    percent = 100 * (changed / base - 1)
    if claim.text in TEXT_AND_TABLE_DIFFER:
        assert abs(percent - claim.quoted) > 100
    elif "doubles" in claim.text:
        assert percent == pytest.approx(claim.quoted, abs=5)
    else:
        assert percent == pytest.approx(claim.quoted, abs=1.0)


def test_claims_refer_to_existing_figures_and_variants():
    assert len({claim.text for claim in CLAIMS}) == len(CLAIMS)
    for claim in CLAIMS:
        assert claim.figure in FIGURES
        if claim.dataset == GEROD:
            assert set(claim.variants) <= set(load_config("ablation").chains)
