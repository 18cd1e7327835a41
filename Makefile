# Needs Python 3.11 or 3.12, pip and make; everything else goes into .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
ARGS ?=
BIN := .venv/bin
INSTALLED := .venv/.installed
# Debian's Python comes without ensurepip, which venv uses; its pip can stand in.
VENV_BY_PIP = { '$(PYTHON)' -m venv --without-pip .venv && '$(PYTHON)' -m pip --python .venv install --quiet pip; }

.PHONY: setup test train demo format lock clean

setup: $(INSTALLED)

# The stamp is touched last, so an interrupted installation is taken up again and a complete one is left alone.
$(INSTALLED): requirements.lock pyproject.toml
	@'$(PYTHON)' -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' 2>/dev/null || \
	  { echo "bipedtrack needs Python 3.11 or 3.12; name one with: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "installing the locked packages into .venv (once; about a minute)"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || '$(PYTHON)' -m venv .venv >/dev/null 2>&1 || $(VENV_BY_PIP)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

test: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

train: setup
	$(BIN)/python -m bipedtrack.train $(ARGS)

# Films the policy that ships through every kind of task step; needs no screen (EGL or OSMesa).
demo: setup
	$(BIN)/python -m bipedtrack.video models/policies/best.npz --script curricula/footsteps/composite.csv --out demo.mp4

format: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Keeps every pin that still fits pyproject.toml; delete requirements.lock's contents to renew them all.
lock: setup
	$(BIN)/uv pip compile --quiet --universal --fork-strategy fewest --python-version 3.11 --extra dev --generate-hashes --no-annotate \
	  --custom-compile-command "make lock" --output-file requirements.lock pyproject.toml

clean:
	rm -rf .venv build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
