# Everything here needs Python 3.11 or newer, with venv, and make.
# The browser tests (make test runs them where Chromium is found) need Debian's package `chromium`.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo serve test lint format bench soak clean

demo: $(READY)
	$(BIN)/toolpost demo

serve: $(READY)
	$(BIN)/toolpost serve --config docs/examples/workshop.toml --data toolpost-data

test: $(READY)
	$(BIN)/pytest

soak: $(READY)
	$(BIN)/pytest -m soak --timeout 3600

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY)
	$(BIN)/python -m bench

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist toolpost-data .mypy_cache .pytest_cache .ruff_cache .hypothesis
