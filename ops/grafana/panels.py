"""A Grafana panel from its title, unit and queries, and how to write a query.

Names are those of `slotfilm_dist/metrics.py` with `ray_slotfilm_` in front, or of the recording rules in
`ops/prometheus/rules`.
"""

from dataclasses import dataclass
from typing import Any

SOURCE = {"type": "prometheus", "uid": "${datasource}"}
BY_RUN = "by (run)"
RUNS = 'run=~"$run"'
WIDTH, HEIGHT = 24, 8
"""Grafana's columns of a row, and the rows of a panel."""


def gauge(name: str, by: str = BY_RUN, where: str = RUNS) -> str:
    """The value of a metric that the driver reports."""
    return f"max {by} (ray_slotfilm_{name}{{{where}}})"


def total(name: str, by: str = BY_RUN) -> str:
    """A counter's total over all workers."""
    return f"sum {by} (ray_slotfilm_{name}{{{RUNS}}})"


def recorded(name: str, by: str = BY_RUN, where: str = RUNS) -> str:
    """A recorded series."""
    return f"max {by} ({name}{{{where}}})"


def quantile(share: float, name: str) -> str:
    """A quantile of a duration, over the last minutes."""
    buckets = f"ray_slotfilm_{name}_bucket{{{RUNS}}}[5m]"
    return f"histogram_quantile({share}, sum by (run, le) (rate({buckets})))"


@dataclass(frozen=True, kw_only=True, slots=True)
class Panel:
    """One panel: queries with their legends."""

    title: str
    unit: str
    queries: dict[str, str]
    """Legend to query."""
    kind: str = "timeseries"
    width: int = 8
    help: str = ""
    merged: bool = False
    """Show the queries as columns of one table, a row for each set of labels."""

    def to_json(self, number: int, x: int, y: int) -> dict[str, Any]:
        """As Grafana reads it."""
        targets = [
            {"refId": chr(65 + i), "datasource": SOURCE, "expr": query, "legendFormat": legend}
            | ({"instant": True, "range": False} if self.kind != "timeseries" else {})
            | ({"format": "table"} if self.kind == "table" else {})
            for i, (legend, query) in enumerate(self.queries.items())
        ]
        return {
            "id": number,
            "type": self.kind,
            "title": self.title,
            "description": self.help,
            "datasource": SOURCE,
            "gridPos": {"x": x, "y": y, "w": self.width, "h": HEIGHT},
            "fieldConfig": {"defaults": {"unit": self.unit}, "overrides": []},
            "transformations": self._transformations(),
            "targets": targets,
        }

    def _transformations(self) -> list[dict[str, Any]]:
        if not self.merged:
            return []
        columns = {f"Value #{chr(65 + i)}": name for i, name in enumerate(self.queries)}
        shown = {"excludeByName": {"Time": True}, "renameByName": columns}
        return [{"id": "merge", "options": {}}, {"id": "organize", "options": shown}]


def stat(title: str, unit: str, query: str) -> Panel:
    """The latest value of every run."""
    return Panel(title=title, unit=unit, queries={"{{run}}": query}, kind="stat", width=4)


def lines(title: str, unit: str, queries: dict[str, str], help: str = "") -> Panel:
    """Curves over time."""
    return Panel(title=title, unit=unit, queries=queries, help=help)
