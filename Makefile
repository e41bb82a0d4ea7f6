# Every target works from a fresh clone: those that need the virtual environment make it first.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all check doctor bench bench-peers clean distclean

PYTEST_ARGS ?=
BENCH_ARGS ?=

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo '  Variables: PYTHON, PIP_EXTRA_ARGS (set-up), PYTEST_ARGS (test), BENCH_ARGS (bench)'

setup: ## Make .venv with all dependencies, and a Vulkan driver where there is none
	@bash ops/setup.sh

demo: setup ## Train an agent for about ten minutes and write a report
	@.venv/bin/slotfilm train quick
	@run=$$(ls -td runs/*/ 2>/dev/null | head -n 1); \
	pages=$$(find "$$PWD/$$run" -maxdepth 2 -name '*.html' 2>/dev/null | sort); \
	printf '\nThe run is in %s\n' "$$run"; \
	if [ -n "$$pages" ]; then printf 'Open its report in a browser: file://%s\n' $$pages; fi

test: ## Run every test that this machine can run, but the slow ones
	@bash ops/setup.sh --test
	@.venv/bin/python -m pytest -m 'not slow' $(PYTEST_ARGS)

test-all: ## Run the slow tests as well
	@bash ops/setup.sh --test
	@.venv/bin/python -m pytest $(PYTEST_ARGS)

check: setup ## Check format, lint, types, and unit tests with branch coverage
	@bash ops/check.sh

doctor: setup ## Show what this machine can do, with a fix for each lack
	@.venv/bin/slotfilm doctor

bench: setup ## Measure speed as ratios against what one would pick instead
	@.venv/bin/slotfilm bench $(BENCH_ARGS)

bench-peers: setup ## Install what `make bench` compares with apart, into .peers
	@.venv/bin/python -m venv .peers
	@site=$$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))'); \
	peers=$$(.peers/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))'); \
	echo "import site; site.addsitedir('$$site')" > "$$peers/project.pth"
	@.peers/bin/python -m pip install --no-input $(PIP_EXTRA_ARGS) -r slotfilm_dist/bench/peers/requirements.txt

clean: ## Remove caches and build outputs; runs and artifacts stay
	@rm -rf build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .coverage .coverage.* htmlcov
	@find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## Also remove .venv and .peers
	@rm -rf .venv .peers
