# The two commands of a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test bench bench-compare eval clean

# Each stamp is an installation; it is redone when what it installs changes.
$(VENV)/demo.stamp: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/test.stamp: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet torch==2.13.0
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[cgn,views,cluster,notebooks,dev]'
	touch $@ $(VENV)/demo.stamp

demo: $(VENV)/demo.stamp
	$(BIN)/tog demo --out out/demo

test: $(VENV)/test.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	# NumPy for Python 3.10 is an older one, with other types than those that are checked here.
	$(BIN)/python -c 'import sys; sys.exit(sys.version_info >= (3, 11))' || $(BIN)/mypy
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

# Each run is saved under out/bench; `make bench-compare` sets a new one beside the last, or beside
# the one that it is given: `make bench-compare RUN=0001`.
BENCH = $(BIN)/python -m pytest tests/benchmarks/bench_stages.py tests/benchmarks/bench_peers.py \
	tests/benchmarks/bench_contact_graspnet.py \
	--benchmark-storage=out/bench --benchmark-columns=median,iqr,rounds --benchmark-sort=fullname

bench: $(VENV)/test.stamp
	$(BENCH) --benchmark-autosave
	$(BIN)/python -m pytest tests/benchmarks/bench_planning.py

bench-compare: $(VENV)/test.stamp
	$(BENCH) --benchmark-compare$(if $(RUN),=$(RUN))

eval: $(VENV)/test.stamp
	$(BIN)/tog eval builtin --selectors top-score,oracle,geometric --out out/eval

clean:
	rm -rf $(VENV) out dist build
