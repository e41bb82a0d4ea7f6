import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.evaluation.reward_windows import TABLE_TERMS, WINDOWS
from slotfilm_dist.evaluation.study import paper
from slotfilm_dist.evaluation.study.table_items import value_at
from slotfilm_dist.variants import VARIANTS


def test_every_figure_and_table_of_the_paper_is_there_once():
    figures = [*(f"Figure {n}" for n in range(3, 17)), "Figure A1"]
    tables = [*(f"Table {n}" for n in range(1, 4)), *(f"Table A{n}" for n in range(1, 5))]
    assert [item.number for item in paper.ITEMS] == figures + tables


def test_items_name_variants_that_exist():
    for item in paper.ITEMS:
        assert set(item.variants) <= VARIANTS.keys()
        assert {name for name, _, _ in item.returns} | set(item.needs) <= set(item.variants)


def test_shares_of_a_window_add_up_to_all():
    for window in WINDOWS:
        total = sum(paper.TABLE_2[window, term][0] for term in TABLE_TERMS)
        assert total == pytest.approx(100.0, abs=0.05)


def test_probe_rows_have_the_five_printed_scores():
    table = next(item for item in paper.ITEMS if item.number == "Table 3")
    assert set(paper.TABLE_3) == set(table.variants)
    assert all(len(row) == 5 <= len(paper.PROBE_SCORES) for row in paper.TABLE_3.values())


def test_defaults_of_the_config_are_the_printed_hyperparameters():
    for name, printed, path in paper.TABLE_A1:
        value = value_at(RunConfig(), path)
        plain = printed.replace(",", "").replace(" M", "000000")
        if isinstance(value, tuple):
            assert plain.split() == [str(part) for part in value], name
        else:
            assert float(plain) == value, name
