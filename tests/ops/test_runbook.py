"""The runbook and the alerts speak of the same things."""

import re
from pathlib import Path

import yaml

OPS = Path(__file__).parents[2] / "ops"
RULES = [r for g in yaml.safe_load((OPS / "prometheus/rules/alerts.yml").read_text())["groups"] for r in g["rules"]]
OTHERS = ["Jobs", "Machines of your own"]
"""Sections that are no alert's, at the end."""


def sections() -> dict[str, str]:
    """The runbook's sections by heading."""
    _, *parts = re.split(r"^## ", (OPS / "runbook.md").read_text(), flags=re.MULTILINE)
    return {part.splitlines()[0]: part for part in parts}


def test_every_alert_has_a_section_and_every_section_an_alert() -> None:
    assert list(sections()) == [*(rule["alert"] for rule in RULES), *OTHERS]


def test_every_section_says_what_it_means_how_to_see_it_and_what_to_do() -> None:
    for name, text in sections().items():
        if name in OTHERS:
            continue
        assert [word for word in ("**Means.**", "**See.**", "**Do.**") if word not in text] == [], name


def test_every_alert_links_to_its_section_and_has_a_severity() -> None:
    for rule in RULES:
        assert rule["annotations"]["runbook"] == f"ops/runbook.md#{rule['alert'].lower()}"
        assert rule["labels"]["severity"] in {"page", "ticket"}


def test_dashboards_and_panels_that_the_runbook_names_exist() -> None:
    boards = [yaml.safe_load(path.read_text()) for path in (OPS / "grafana" / "dashboards").glob("*.json")]
    known = {board["title"] for board in boards} | {panel["title"] for board in boards for panel in board["panels"]}
    named = {
        " ".join(name.split())
        for name in re.findall(r"(?<!\*)\*([A-Z][^*]+)\*(?!\*)", (OPS / "runbook.md").read_text())
    }
    assert len(named) > 10
    assert named <= known


def test_alerts_named_anywhere_in_the_runbook_exist() -> None:
    named = set(re.findall(r"Slotfilm[A-Z]\w+", (OPS / "runbook.md").read_text()))
    assert named == {rule["alert"] for rule in RULES}
