"""Finds Ray dashboards, and whether they ask for a token."""

import contextlib
import http.client
import json
import socket
import urllib.error
import urllib.parse
import urllib.request
from typing import Literal

DASHBOARD_PORT = 8265
PROBE_TIMEOUT_S = 3.0
LARGEST_ANSWER = 1 << 24
"""Bytes of a list of jobs that are read."""


def dashboard_urls(ray_address: str) -> list[str]:
    """Where a dashboard that matters would answer: this machine's, and that of the cluster in `RAY_ADDRESS`."""
    hosts = [f"127.0.0.1:{DASHBOARD_PORT}"]
    with contextlib.suppress(OSError):
        hosts.append(f"{socket.gethostbyname(socket.gethostname())}:{DASHBOARD_PORT}")
    urls = [f"http://{host}" for host in hosts]
    if ray_address.startswith(("http://", "https://")):
        urls.append(ray_address.rstrip("/"))
    elif ray_address not in ("", "auto", "local"):
        host = urllib.parse.urlsplit(ray_address if "//" in ray_address else f"//{ray_address}").hostname
        urls += (
            [f"http://[{host}]:{DASHBOARD_PORT}" if ":" in host else f"http://{host}:{DASHBOARD_PORT}"] if host else []
        )
    return list(dict.fromkeys(urls))


def probe_dashboard(url: str) -> Literal["open", "closed", "none"]:
    """Ask a dashboard for its jobs without a token: `none` where no Ray dashboard answers."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}), urllib.request.HTTPHandler())
    try:
        with direct.open(f"{url}/api/jobs/", timeout=PROBE_TIMEOUT_S) as answer:
            listed = json.loads(answer.read(LARGEST_ANSWER))
    except urllib.error.HTTPError as error:
        return "closed" if error.code in (401, 403) else "none"
    except (OSError, ValueError, http.client.HTTPException):
        return "none"
    return "open" if isinstance(listed, list) else "none"
