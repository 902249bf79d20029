# Two commands do everything on a fresh Debian or Ubuntu machine: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# Our matrices are small and many: a second BLAS thread makes them slower, on a busy machine 70 times (measured).
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help demo test lint bench janot fuzz soak lock clean

help:
	@echo "make demo    emulate, drive, record and identify a six-axis arm; the report is out/demo/report.html"
	@echo "make test    the whole test suite"
	@echo "make lint    style, types and import contracts"
	@echo "make bench   timings, as ratios against peers"
	@echo "make janot   the tables of Janot et al. 2014 on the emulated TX40, beside the paper's"
	@echo "make fuzz    10 million random and mutated frames into drive, host and decoder"
	@echo "make soak    a minute in real time: lost frames, late cycles, cost of the recorder"
	@echo "make lock    resolve requirements.lock anew (needs uv)"

demo: $(READY)
	$(BIN)/armrig demo --out out/demo

test: $(READY)
	$(BIN)/pytest

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY)
	$(BIN)/armrig bench

janot: $(READY)
	$(BIN)/python tests/studies/janot2014.py

fuzz: $(READY)
	$(BIN)/python tests/studies/fuzz.py

soak: $(READY)
	$(BIN)/python tests/studies/soak.py

# The kernels are compiled here once, so that nothing later waits for the compiler.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "armrig needs Python 3.11 or newer as '$(PYTHON)'; set PYTHON=/path/to/python3.11 or install python3." >&2; exit 2; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then apt-get update -qq && apt-get install -y -qq python3-venv; \
	  else echo "Python's venv module is missing: sudo apt-get install python3-venv" >&2; exit 2; fi; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	$(BIN)/armrig doctor
	@touch $@

lock:
	uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --no-annotate --no-header --group dev pyproject.toml -o requirements.lock

clean:
	rm -rf .venv out .pytest_cache .mypy_cache .ruff_cache .hypothesis
