# Needs nothing but Python >= 3.11 and this checkout. No compiler, no GPU.
#
#   make demo    take photos of a scene, train on them, evaluate, write exposure brackets and a report to runs/demo
#   make test    run the tests
#   make lint    ruff and pyright
#   make docs    build the pages into site/
#
# Each makes a virtual environment in VENV once, with the versions of constraints.txt.

PYTHON ?= python3
VENV ?= .venv
DEMO ?= runs/demo
# 70 to 105 s of training on two idle cores.
DEMO_FIELDS = --densification.cap-max 40000 --model.initial-density 14
PYTEST ?= -q -n auto --dist worksteal

BIN = $(VENV)/bin
PIP = $(BIN)/python -m pip --disable-pip-version-check install -qq --no-compile --constraint constraints.txt
# On all cores, which pip does not. Not left to the first import: that of a full disk would leave half a file.
COMPILE = $(BIN)/python -m compileall -qq -j 0 $(VENV)/lib sehdr_warp || true

# Editable as one plain line in site-packages, which editors and type checkers can follow; setuptools' default is an import
# hook, which they cannot. The links sehdr_warp/kernels and sehdr_warp/configs complete the package in a checkout.
EDITABLE = $(PIP) --no-build-isolation --config-settings editable_mode=compat --editable

# torch's CPU build, a tenth of the size of the CUDA build that PyPI has for Linux: from wherever pip is set up to
# look, else from PyTorch's own index (on macOS the build has no +cpu in its version).
TORCH = $(shell sed -n 's/^torch==//p' constraints.txt)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

.PHONY: demo demo-eval demo-render demo-report test lint docs pictures reports

demo: $(VENV)/installed
	$(BIN)/sehdr-warp synth embedded:lamps --out $(DEMO)/lamps --response camera --overwrite
	$(BIN)/sehdr-warp train $(DEMO)/lamps --out $(DEMO)/run --preset fast $(DEMO_FIELDS) --response camera --device cpu --overwrite
	@$(MAKE) --no-print-directory --jobs=2 demo-eval demo-render demo-report
	@echo
	@echo "Made: a trained HDR scene in $(DEMO)/run, its figures in $(DEMO)/eval.json."
	@echo "Next: source $(BIN)/activate, then sehdr-warp view $(DEMO)/run. Brackets as OpenEXR: $(DEMO)/views/brackets"
	@echo "Open in a browser: $(DEMO)/report/report.html: the lamps that photos clip, three stops darker"

demo-eval:
	$(BIN)/sehdr-warp eval $(DEMO)/run --json $(DEMO)/eval.json --device cpu --overwrite

demo-render:
	$(BIN)/sehdr-warp render $(DEMO)/run --out $(DEMO)/views --evs=-4,-2,0,2,4 --device cpu --overwrite

demo-report:
	$(BIN)/sehdr-warp report $(DEMO)/run --out $(DEMO)/report --device cpu --overwrite

test: $(VENV)/installed-test
	$(BIN)/python -m pytest $(PYTEST)

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --project pyproject.toml --pythonpath $(BIN)/python

docs: $(VENV)/installed-dev
	env NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# The tables and plots of docs/reports, from the results stored there.
reports: $(VENV)/installed
	$(BIN)/python -m benchmarks.report_pages

# The pictures of README and guide: trains a scene that clips, a few minutes on two cores. That of the viewer needs
# Chromium, and playwright, which `make test` installs.
pictures: $(VENV)/installed
	$(BIN)/python docs/pictures.py

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) torch==$(TORCH)+cpu setuptools wheel 2>/dev/null || \
		$(PIP) torch==$(TORCH) setuptools wheel --extra-index-url $(TORCH_INDEX)
	$(EDITABLE) .
	$(COMPILE)
	touch $@

$(VENV)/installed-test: $(VENV)/installed
	$(EDITABLE) '.[test,test-interop]'
	$(COMPILE)
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(EDITABLE) '.[dev]'
	$(COMPILE)
	touch $@
