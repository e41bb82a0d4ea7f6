"""Prints what every panel of the dashboards shows now, as a table, from a live Prometheus.

    python ops/panels.py [http://127.0.0.1:9090] [--run REGEX] [--over SECONDS]

The value of a panel is the last finite one of each query within that time; several series are shown as a range.
"""

import argparse
import json
import math
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

DASHBOARDS = Path(__file__).parent / "grafana" / "dashboards"


def series(url: str, query: str, start: float, end: float) -> list[float]:
    """The last finite value of every series that a query gives within a time.

    Raises:
        ValueError: Prometheus does not answer, or refuses the query.
    """
    step = max(1.0, (end - start) / 1000)
    words = urllib.parse.urlencode({"query": query, "start": start, "end": end, "step": step})
    try:
        with urllib.request.urlopen(f"{url}/api/v1/query_range?{words}", timeout=30) as answer:
            result = json.load(answer)["data"]["result"]
    except urllib.error.HTTPError as error:
        raise ValueError(f"{query}: {error.read().decode()}") from None
    except OSError as error:
        raise ValueError(f"{url} does not answer ({error}); is Prometheus running there?") from None
    finite = [[number for _, value in one["values"] if math.isfinite(number := float(value))] for one in result]
    return [numbers[-1] for numbers in finite if numbers]


def shown(values: list[float], unit: str) -> str:
    """One value, or the range of several, with the panel's unit."""
    if not values:
        return "-"
    scale, word = {"percentunit": (100.0, " %"), "percent": (1.0, " %"), "s": (1.0, " s"), "bytes": (1e-6, " MB")}.get(
        unit, (1.0, "")
    )
    low, high = (f"{value * scale:.4g}" for value in (min(values), max(values)))
    return f"{low}{word}" if low == high else f"{low} to {high}{word}"


def rows(url: str, run: str, over_s: float, end: float | None = None) -> list[tuple[str, str, str, int]]:
    """Dashboard, panel, value and number of series of every panel, in the dashboards' order."""
    end = end or time.time()
    found: list[tuple[str, str, str, int]] = []
    for path in sorted(DASHBOARDS.glob("*.json")):
        dashboard: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for panel in dashboard["panels"]:
            queries = [target["expr"].replace("$run", run) for target in panel["targets"]]
            values = [value for query in queries for value in series(url, query, end - over_s, end)]
            unit = panel["fieldConfig"]["defaults"]["unit"]
            found.append((dashboard["title"], panel["title"], shown(values, unit), len(values)))
    return found


def main() -> int:
    """Print the table; gives the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url", nargs="?", default="http://127.0.0.1:9090", help="of Prometheus")
    parser.add_argument("--run", default=".*", help="regular expression of the runs' names (default: all)")
    parser.add_argument("--over", type=float, default=300.0, metavar="SECONDS", help="how far to look back")
    options = parser.parse_args()
    try:
        table = rows(options.url, options.run, options.over)
    except ValueError as error:
        print(f"panels: {error}", file=sys.stderr)
        return 2
    print("| dashboard | panel | value | series |\n|---|---|---|---|")
    for row in table:
        print(f"| {' | '.join(map(str, row))} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
