"""Every panel of every dashboard shows what a real run gave to a real Prometheus."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

GRAFANA = Path(__file__).parents[2] / "ops" / "grafana"
DASHBOARDS = sorted((GRAFANA / "dashboards").glob("*.json"))
EMPTY_PANELS = {
    "Alerts": "nothing is wrong",
    "GPU": "the run has none",
}
"""Panels without data in a healthy run on a CPU, each with the reason."""
UNITS = {"none", "short", "s", "bytes", "percent", "percentunit"}


def panels_of(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text())["panels"]


def query_of(target: dict[str, Any]) -> str:
    """A panel's query with Grafana's variables filled in as for all runs."""
    query = target["expr"].replace("$run", ".*")
    assert "$" not in query, query
    return query


def test_four_dashboards_are_there() -> None:
    assert [path.stem for path in DASHBOARDS] == ["grid", "learner", "overview", "workers"]


def test_files_are_what_the_builder_writes(tmp_path: Path) -> None:
    subprocess.run([sys.executable, str(GRAFANA / "build.py"), str(tmp_path)], check=True, timeout=60)
    for path in DASHBOARDS:
        assert (tmp_path / path.name).read_text() == path.read_text(), f"run {GRAFANA.name}/build.py again"


@pytest.mark.parametrize("path", DASHBOARDS, ids=lambda path: path.stem)
def test_every_panel_gives_data(watched: Any, path: Path) -> None:
    queries = {query_of(target): panel["title"] for panel in panels_of(path) for target in panel["targets"]}
    empty = {queries[query] for query in watched.without_data(queries)}
    assert empty <= EMPTY_PANELS.keys(), empty


def test_table_of_panels_has_a_value_for_every_panel_with_data(watched: Any) -> None:
    url = f"http://127.0.0.1:{watched.prometheus.port}"
    seconds = str(watched.seconds_since_start())
    command = [sys.executable, str(GRAFANA.parent / "panels.py"), url, "--over", seconds]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    _, _, *lines = printed.splitlines()
    values = {panel: value for _, panel, value, _ in (line.strip("| ").split(" | ") for line in lines)}
    assert {panel for panel, value in values.items() if value == "-"} <= EMPTY_PANELS.keys()
    assert values.keys() >= EMPTY_PANELS.keys()
    assert values["Updates per environment step"].startswith("0.")


def test_table_of_panels_says_when_prometheus_is_not_there() -> None:
    command = [sys.executable, str(GRAFANA.parent / "panels.py"), "http://127.0.0.1:1"]
    answer = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert answer.returncode == 2
    assert "is Prometheus running there?" in answer.stderr


@pytest.mark.parametrize("path", DASHBOARDS, ids=lambda path: path.stem)
def test_dashboard_is_well_formed(path: Path) -> None:
    dashboard = json.loads(path.read_text())
    panels = dashboard["panels"]
    assert dashboard["uid"] == f"slotfilm-{path.stem}"
    assert [v["name"] for v in dashboard["templating"]["list"]] == ["datasource", "run"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    assert len({panel["title"] for panel in panels}) == len(panels)
    for panel in panels:
        assert panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}
        assert panel["fieldConfig"]["defaults"]["unit"] in UNITS
        assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"]) > 0
        assert all(target["datasource"] == panel["datasource"] for target in panel["targets"])


@pytest.mark.parametrize("path", DASHBOARDS, ids=lambda path: path.stem)
def test_no_two_panels_overlap(path: Path) -> None:
    taken: set[tuple[int, int]] = set()
    for panel in panels_of(path):
        place = panel["gridPos"]
        cells = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not cells & taken, panel["title"]
        assert all(x < 24 for x, _ in cells)
        taken |= cells


def test_provisioning_points_at_what_compose_mounts() -> None:
    services = yaml.safe_load((GRAFANA.parent / "compose.yaml").read_text())["services"]
    mounts = {target: source for source, target, *_ in (m.split(":") for m in services["grafana"]["volumes"])}
    provider = yaml.safe_load((GRAFANA / "provisioning" / "dashboards" / "slotfilm.yml").read_text())["providers"][0]
    assert (GRAFANA.parent / mounts[provider["options"]["path"]]).resolve() == GRAFANA / "dashboards"
    assert (GRAFANA.parent / mounts["/etc/grafana/provisioning"]).resolve() == GRAFANA / "provisioning"
    source = yaml.safe_load((GRAFANA / "provisioning" / "datasources" / "prometheus.yml").read_text())["datasources"][0]
    assert f"--web.listen-address={source['url'].removeprefix('http://')}" in services["prometheus"]["command"]


def test_compose_listens_on_the_loopback_and_holds_no_password() -> None:
    text = (GRAFANA.parent / "compose.yaml").read_text()
    compose = yaml.safe_load(text)
    settings = compose["services"]["grafana"]["environment"]
    assert settings["GF_SERVER_HTTP_ADDR"] == "127.0.0.1"
    assert settings["GF_AUTH_ANONYMOUS_ENABLED"] == "false"
    assert not [name for name in settings if "PASSWORD" in name and not name.endswith("__FILE")]
    assert compose["secrets"]["grafana_password"]["file"].startswith("${GRAFANA_PASSWORD_FILE:?")
    assert "ports" not in compose["services"]["prometheus"] | compose["services"]["grafana"]
    for service in compose["services"].values():
        assert ":" in service["image"]
        assert not service["image"].endswith(":latest")
