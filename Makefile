# `make demo` and `make test` need Python 3.11 or newer and nothing else. The
# environment in .venv is made once; it is touched again when pyproject.toml changes.

PYTHON  ?= $(shell command -v python3.11 || command -v python3)
WORKERS ?= 2
COMPILER ?= user
PROGRAMS ?= 2000

VENV := .venv
PY   := $(VENV)/bin/python
PIP  := $(PY) -m pip install --disable-pip-version-check

# The closed `mkl` wheel exists for some platforms only: without it SciPy's solver works.
comma := ,
define install
	@$(PIP) -e '.[pardiso$(if $(1),$(comma)$(1))]' || { \
	  echo "make: the extra 'pardiso' cannot be installed here, going on with SciPy's solver."; \
	  $(PIP) -e '.$(if $(1),[$(1)])'; }
endef

.PHONY: demo test test-versions fuzz stress lint bench bench-device peers docs clean help

help:
	@echo "make demo   set up .venv, run the main job, write out/"
	@echo "make test   set up .venv, run the tests (WORKERS=$(WORKERS) processes); COMPILER=quick"
	@echo "            optimises their programs less and takes half of the time"
	@echo "make test-versions  the tests on each Python found, with the oldest dependencies and"
	@echo "            without AVX-512, one table; ONLY=3.13,oldest,avx2 ARGS=tests/test_fem.py"
	@echo "make fuzz   PROGRAMS=$(PROGRAMS) random programs against their plain evaluation"
	@echo "make stress the cases that may break a simulator, and which of them hold"
	@echo "make lint   ruff and pyright"
	@echo "make bench  all benchmarks, page in benchmarks/results/; QUICK=1 for the main ones"
	@echo "make bench-device  kernels on an accelerator and on the CPU (jax[cuda13] in .venv)"
	@echo "make peers  the codes that the benchmarks compare with, one .peers/<name> each"
	@echo "make docs   the documentation, offline, in docs/_build/html"
	@echo "make clean  remove .venv, .venvs, .peers, out, benchmarks/results and built docs"

demo: $(VENV)/.run
	@$(PY) -m sorojax demo

test: $(VENV)/.test
	SOROJAX_TEST_COMPILER=$(COMPILER) $(PY) -m pytest -n $(WORKERS) --dist loadfile \
	--max-worker-restart 0 $(ARGS)

test-versions: $(VENV)/.made
	@$(PY) -m tests.versions --only '$(ONLY)' --workers $(WORKERS) -- $(ARGS)

fuzz: $(VENV)/.test
	$(PY) -m tests.fuzz_kernels --programs $(PROGRAMS)

stress: $(VENV)/.test
	$(PY) -m pytest -n $(WORKERS) --dist loadfile --max-worker-restart 0 -m stress $(ARGS)

lint: $(VENV)/.dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m tests.user_code
	$(PY) -m pyright --pythonpath $(PY)

bench: $(VENV)/.run
	$(PY) -m benchmarks $(if $(QUICK),--quick)

bench-device: $(VENV)/.run
	JAX_PLATFORMS=cuda,cpu $(PY) -m benchmarks device.sdf device.rods device.fem device.envs

docs: $(VENV)/.docs
	$(PY) -m sphinx -b html -q -W --keep-going docs docs/_build/html
	@echo "wrote docs/_build/html/index.html"

peers: $(VENV)/.run
	$(PY) -m benchmarks.peers install $(PEERS)

$(VENV)/.made:
	@test -n "$(PYTHON)" || { echo "make: found no python3 on the PATH, need Python 3.11 \
	or newer. Install it, or name it: make PYTHON=/path/to/python3.11"; exit 2; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	echo "make: $(PYTHON) is `"$(PYTHON)" --version 2>&1`, need Python 3.11 or newer. \
	Name one: make PYTHON=/path/to/python3.11"; exit 2; }
	@"$(PYTHON)" -m venv --clear $(VENV) || { \
	echo "make: $(PYTHON) cannot make a virtual environment, need its modules venv and \
	ensurepip. On Debian and Ubuntu: apt install python3.11-venv"; exit 2; }
	@touch $@

$(VENV)/.run: pyproject.toml $(VENV)/.made
	$(call install,)
	@touch $@

$(VENV)/.test: pyproject.toml $(VENV)/.made
	$(call install,test)
	@touch $(VENV)/.run $@

$(VENV)/.dev: pyproject.toml $(VENV)/.made
	$(call install,test$(comma)dev)
	@touch $(VENV)/.run $(VENV)/.test $@

$(VENV)/.docs: pyproject.toml $(VENV)/.made
	$(call install,docs)
	@touch $(VENV)/.run $@

clean:
	rm -rf $(VENV) .venvs .peers out benchmarks/results docs/_build docs/_generated docs/reference
