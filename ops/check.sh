#!/usr/bin/env bash
# Every check before a review: format, lint, types, and unit tests with branch coverage. Runs all, then says what failed.
set -uo pipefail
cd "$(dirname "$0")/.."
bin=.venv/bin
[ -x "$bin/python" ] || { echo "check: there is no .venv here; run make setup first" >&2; exit 1; }

failed=()
step() {
  local name="$1"
  shift
  printf '== %s\n' "$name"
  "$@" || failed+=("$name")
}
unit_tests() {
  "$bin/python" -m coverage run --branch --source=slotfilm_dist -m pytest tests/unit || return 1
  "$bin/python" -m coverage report --skip-empty --skip-covered
}

step format "$bin/ruff" format --check .
step lint "$bin/ruff" check .
step types env PYRIGHT_PYTHON_IGNORE_WARNINGS=1 "$bin/pyright" --pythonpath "$bin/python"
step "unit tests" unit_tests

if [ ${#failed[@]} -gt 0 ]; then
  printf 'check: failed: %s\n' "$(IFS=,; echo "${failed[*]}")" >&2
  exit 1
fi
echo "check: all passed"
