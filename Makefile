# Two commands that need nothing but Python >= 3.11 and this checkout. No compiler, no GPU.
#
#   make demo    train the embedded scene, evaluate it, write exposure brackets and pictures into runs/demo
#   make test    run the tests
#
# Both make a virtual environment in VENV and install the versions of constraints.txt there, once.

PYTHON ?= python3
VENV ?= .venv
DEMO ?= runs/demo
DATA ?= embedded
RESPONSE ?= hdr-nerf
EVS ?= -4,-2,0,2,4
PYTEST ?= -q

PIP = $(VENV)/bin/python -m pip --disable-pip-version-check install -qq --constraint constraints.txt
SEHDR = $(VENV)/bin/sehdr-warp

# torch's CPU build, a tenth of the size of the CUDA build that PyPI has for Linux: from wherever pip is set up to
# look, else from PyTorch's own index (on macOS the build has no +cpu in its version).
TORCH = $(shell sed -n 's/^torch==//p' constraints.txt)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

.PHONY: demo test pictures

demo: $(VENV)/installed
	$(SEHDR) train $(DATA) --out $(DEMO)/run --preset demo --response $(RESPONSE) --device cpu --overwrite
	$(SEHDR) eval $(DEMO)/run --json $(DEMO)/eval.json --device cpu --overwrite
	$(SEHDR) render $(DEMO)/run --out $(DEMO)/views --evs=$(EVS) --device cpu --overwrite
	$(SEHDR) report $(DEMO)/run --out $(DEMO)/report --device cpu --overwrite

test: $(VENV)/installed-test
	$(VENV)/bin/python -m pytest $(PYTEST)

# The README's pictures, from the demo's report.
pictures: $(VENV)/installed
	$(VENV)/bin/python docs/pictures.py $(DEMO)/report

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(PIP) torch==$(TORCH)+cpu 2>/dev/null || $(PIP) torch==$(TORCH) --extra-index-url $(TORCH_INDEX)
	$(PIP) setuptools wheel
	$(PIP) --no-build-isolation --editable .
	touch $@

$(VENV)/installed-test: $(VENV)/installed
	$(PIP) --no-build-isolation --editable '.[test]'
	touch $@
