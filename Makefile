# make design   set up ./.venv and run the main job: every design, verified, exported, simulated, reported
# make test     set up ./.venv and run the tests that take seconds
# make slow     the tests that take longer; SHARE=0.5: half of them, drawn anew each time
# make processors   the tests with other kernels of OpenBLAS, and features of numpy, than this processor's own
# make fuzz     damaged input of every kind, for FUZZ_SECONDS (600): see tests/fuzz
# make mutants  faults in the code that refuses, proves, seals and limits: tests have to notice each; see tests/mutants
# make docs     the pages of docs/ to docs/_build: warnings are errors; `make links` asks the addresses they point to
# make wheel    build/wheel/malta-VERSION-py3-none-any.whl, for `pip install` without a checkout
# make architecture, make coverage   who imports whom; which lines the tests run
# make check    what CI runs: lint, format, types, pages, both kinds of tests, some of them as on other processors
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# malta, and beside it what compares it with papers, found by entry points.
PAPERS := --editable papers
# By its path, not by a finder: a script beside a checkout that is called malta imports the package, not that folder.
EDITABLE := --config-settings editable_mode=compat --editable
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt
# Small matrices: threads of the linear algebra only get into each other's way, the more so beside parallel tests.
export OPENBLAS_NUM_THREADS ?= 1
export MPLCONFIGDIR ?= $(CURDIR)/$(VENV)/matplotlib
# Tests start hundreds of commands: each would compile all of malta's modules anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: design test slow processors times fuzz mutants check lint types notebooks docs links wheel bench figures architecture coverage clean

design: $(VENV)/runtime
	$(BIN)/malta design

# One thread of linear algebra for each worker, as the command line has it: more get into each other's way.
test slow processors: export OPENBLAS_NUM_THREADS = 1

test: $(VENV)/dev
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not slow"

slow: $(VENV)/dev
	$(BIN)/python -m pytest -n auto --dist loadfile -m slow

processors: $(VENV)/dev  # RUNS="Prescott:fast Sandybridge:linear" for some of them
	PYTHONPATH=tests $(BIN)/python -m processors $(RUNS)

times: $(VENV)/dev  # measures the fast tests, and names those that take long
	PYTHONPATH=tests $(BIN)/python -m seconds

fuzz: $(VENV)/dev
	PYTHONPATH=tests $(BIN)/python -m fuzz

mutants: $(VENV)/dev
	PYTHONPATH=tests $(BIN)/python -m mutants

# With the kernels that OpenBLAS chooses itself, then with others: an old processor's, and where there is AVX-512 its own.
# A third of the longer tests, drawn anew each time, to end within 90 minutes on a loaded computer: `make slow` runs all.
check:
	env -u OPENBLAS_CORETYPE -u NPY_DISABLE_CPU_FEATURES $(MAKE) lint types docs test
	env -u OPENBLAS_CORETYPE -u NPY_DISABLE_CPU_FEATURES SHARE=0.35 $(MAKE) slow
	SHARE=0.35 $(MAKE) processors RUNS="Prescott:fast Sandybridge:linear SkylakeX:linear"

lint: $(VENV)/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/dev
	$(BIN)/mypy

architecture: $(VENV)/runtime  # packages, their sizes and who imports whom, as the picture of CONTRIBUTING.md
	$(BIN)/python docs/house.py

coverage: $(VENV)/dev  # lines that `make test` runs; the report is in build/coverage
	$(PIP) install --quiet coverage
	$(BIN)/python -m coverage run --source malta --omit "*/templates/*" --data-file build/.coverage -m pytest -q -n 0 -m "not slow"
	$(BIN)/python -m coverage html --data-file build/.coverage -d build/coverage
	$(BIN)/python -m coverage report --data-file build/.coverage | tail -1

notebooks: $(VENV)/dev
	mkdir -p build
	for source in notebooks/*.py; do \
	  name=build/$$(basename $$source .py); \
	  $(BIN)/jupytext --quiet --to ipynb --output $$name.ipynb $$source && \
	  $(BIN)/jupyter nbconvert --log-level=ERROR --to notebook --execute --inplace \
	    --ExecutePreprocessor.kernel_name=python3 $$name.ipynb && \
	  $(BIN)/jupyter nbconvert --log-level=ERROR --to html $$name.ipynb || exit 1; \
	done
	@ls build/*.html

docs: $(VENV)/docs
	$(BIN)/python -m sphinx -W --keep-going -n -q docs docs/_build/html
	@echo docs/_build/html/index.html

links: $(VENV)/docs  # needs a network
	$(BIN)/python -m sphinx -W --keep-going -q -b linkcheck docs docs/_build/links

wheel: $(BIN)/python  # malta as one file, for `pip install` on computers without a checkout; malta-papers beside it
	rm -rf build/wheel build/lib build/bdist.*
	$(PIP) --quiet wheel --no-deps --wheel-dir build/wheel . ./papers
	rm -rf build/lib build/bdist.* papers/build
	@ls build/wheel/*.whl

bench: $(VENV)/dev  # with PAGE=docs/benchmarks.md it writes that page
	$(BIN)/python bench/run.py $(if $(PAGE),--page $(PAGE))

figures: $(VENV)/dev  # the pictures of the README, of the theory pages, of notebooks that were executed, and of the gallery
	$(BIN)/python docs/notebook_pages.py
	$(BIN)/python docs/page_figures.py
	$(BIN)/python -c "import malta; c = malta.gains.read('design/gains/calibrated.json'); \
	  run = malta.simulate(malta.plant_of(c.parameters), c, malta.Scenario.stroke()); \
	  malta.report.stroke_figure(run, malta.model.published('data/tubular.toml'), 'design/figures/stroke.svg')"
	$(BIN)/malta plot design/gains/calibrated.json marginmap --x K_A --y K_B --out design/figures/margin_map.svg
	$(BIN)/malta simulate design/gains/calibrated.json --scenario stroke --out build
	$(BIN)/malta motion design/gains/calibrated.json build/calibrated_stroke.npz --out design/figures/stroke.gif
	$(BIN)/malta motion design/gains/calibrated.json build/calibrated_stroke.npz --dark --out design/figures/stroke_dark.gif
	$(BIN)/python docs/gallery.py

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "malta needs Python 3.11 or newer; name one with: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(VENV)/runtime: $(BIN)/python pyproject.toml papers/pyproject.toml constraints.txt
	$(PIP) install --quiet $(EDITABLE) . $(PAPERS)
	touch $@

$(VENV)/dev: $(BIN)/python pyproject.toml papers/pyproject.toml constraints.txt
	$(PIP) install --quiet $(EDITABLE) '.[dev]' $(PAPERS)
	touch $@ $(VENV)/runtime $(VENV)/docs

$(VENV)/docs: $(BIN)/python pyproject.toml papers/pyproject.toml constraints.txt
	$(PIP) install --quiet $(EDITABLE) '.[docs]' $(PAPERS)
	touch $@ $(VENV)/runtime

clean:
	rm -rf $(VENV) build docs/_build *.egg-info papers/*.egg-info
