# Two commands do everything on a bare machine: `make demo` and `make test`.
PYTHON ?= python3
# One tested torch for development and CI; users get any torch in pyproject's range.
TORCH  ?= torch==2.13.0
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.PHONY: install demo test types pytest test-slow test-gpu gpu check fmt bench docs clean

install: $(STAMP)

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || \
	  { echo "tumble needs Python 3.11, 3.12 or 3.13: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@test -f $(VENV)/.created && $(BIN)/python -c 'import sys' 2>/dev/null || \
	  { rm -rf $(VENV); $(PYTHON) -m venv $(VENV) && touch $(VENV)/.created; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[synth,cuda,view,cluster,dev]'
	@touch $@

demo: install
	$(BIN)/tumble demo -o runs/demo

test: install
	$(BIN)/ruff check .
	@$(MAKE) --no-print-directory -j 2 types pytest

types: install
	$(BIN)/basedpyright

pytest: install
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-slow: install
	$(BIN)/python -m pytest -m slow

test-gpu: install
	$(BIN)/python -m pytest -m gpu

# Without a network: with the venv if there is one, else with the packages that PYTHON finds. Results go to $OUT.
gpu: python = $(or $(wildcard $(BIN)/python),$(PYTHON))
gpu:
	$(python) -m benchmarks.requirements
	$(python) -m benchmarks.gpu

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

fmt: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: install
	OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m benchmarks.kernels

docs: install
	$(BIN)/python docs/make_api.py build/docs

clean:
	rm -rf $(VENV) runs/demo .pytest_cache .ruff_cache
