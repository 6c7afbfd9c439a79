# `make demo` and `make test` work on a fresh machine: they create the virtual environment .venv.
# torch comes from the configured package index. PIP_EXTRA_INDEX_URL may name an index of wheels without GPU libraries.

PYTHON = $(shell for candidate in python3.13 python3.12 python3.11 python3; do \
	"$$candidate" -c 'import ensurepip, sys, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
		2>/dev/null && echo "$$candidate" && break; done)
BIN := $(if $(filter Windows_NT,$(OS)),.venv/Scripts,.venv/bin)

# One thread of linear algebra per process: the workers of tests and bakes already use every core.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo picture gallery test test-statistics test-engines test-blender lint site docs docs-commands wheel messages \
	bench gpu shipped clean
PYTEST = $(BIN)/python -m pytest --numprocesses auto --dist worksteal

demo: .venv/installed-evaluate,preview
	$(BIN)/prtbake demo --out demo

picture: .venv/installed-evaluate
	$(BIN)/prtbake demo --out demo/picture --quality fine
	cp demo/picture/spot.png demo/picture/comparison.png docs/pictures/

# docs/gallery.md and its pictures, in about half an hour on two cores. It resumes; bench/gallery holds assets and references.
gallery: .venv/installed-evaluate
	$(BIN)/python docs/make_gallery.py

test: .venv/installed-dev .venv/apart/installed
	$(PYTEST) -m "not statistics and not engines"

# Tests that need many samples: calibration, Mitsuba, extremes, whole bakes and trainings.
test-statistics: .venv/installed-dev .venv/apart/installed
	$(PYTEST) -m "statistics and not engines"

# Other people's programs on exported files: Chromium, Node.js packages, a C compiler. What is not installed is said and skipped.
test-engines: .venv/installed-dev site tests/engines/node_modules/.package-lock.json
	$(BIN)/python -m pytest -m engines -rs --ignore tests/engines/test_blender.py tests/engines

# Blender as a Python module, 1 GB, in an environment of its own.
test-blender: .venv/installed-dev .venv/blender/installed
	$(BIN)/python -m pytest -m engines -rs tests/engines/test_blender.py

lint: .venv/installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# The packages of the page of `prtbake export`: needs npm, which fetches them once. The page itself fetches nothing.
PAGE = prt_bake/export/page
site: $(PAGE)/vendor/VERSIONS

$(PAGE)/vendor/VERSIONS: $(PAGE)/package.json $(PAGE)/package-lock.json $(PAGE)/vendor.mjs
	@command -v npm >/dev/null || { echo "prtbake: make site needs npm, which comes with Node.js 20 or newer" >&2; exit 1; }
	cd $(PAGE) && npm ci --ignore-scripts --no-audit --no-fund --loglevel error && npm run --silent vendor
	rm -rf $(PAGE)/node_modules

# The documentation site: docs/build/html/index.html. Warnings are errors; nothing is fetched.
docs: .venv/installed-dev
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --doctree-dir docs/build/doctrees docs docs/build/html

# Runs the commands of the pages, each page in an empty folder: make docs-commands [PAGES="README.md docs/start/*.md"]. An hour.
docs-commands: .venv/installed-dev
	$(BIN)/python -m tests.documents.run $(PAGES)

# The source distribution and the wheel of a release in dist/. With TAG=v1.2.3 the version must be 1.2.3.
wheel: .venv/installed-dev site
	@test -z "$(TAG)" || grep -q '^version = "$(patsubst v%,%,$(TAG))"$$' pyproject.toml \
		|| { echo "prtbake: $(TAG) is not the version of pyproject.toml" >&2; exit 1; }
	rm -rf dist build
	$(BIN)/python -c 'from setuptools import build_meta as b; b.build_sdist("dist"); b.build_wheel("dist")'

# Every message of an error or a warning, by file, for a reader of all of them.
messages: .venv/installed-dev
	@$(BIN)/python -m tests.messages

bench: .venv/installed-dev
	$(BIN)/python -m tests.bench.bake_error --model prt_bake/shipped/spot.pt --mesh prt_bake/shipped/spot.obj --out bench
	$(BIN)/python -m tests.bench.network_speed
	$(BIN)/python -m tests.bench.detail_in_light
	$(BIN)/python -m tests.bench.training --out bench/training.json
	$(BIN)/python -m tests.bench.same_rows scenes/grape/grape.toml
	$(BIN)/python -m tests.bench.smooth_training
	$(BIN)/python -m tests.bench.noise_of_a_walk
	$(BIN)/python -m tests.bench.importance
	$(BIN)/python -m tests.bench.network_render
	$(BIN)/python -m tests.bench.frames
	$(BIN)/python -m tests.bench.preview
	$(BIN)/python -m tests.bench.large_skies
	$(BIN)/python -m tests.bench.noise_free_comparison
	$(BIN)/python -m tests.bench.picture_error
	$(BIN)/python -m tests.bench.mitsuba_speed
	$(BIN)/python -m tests.bench.walk_cost
	$(BIN)/python -m tests.bench.extremes
	$(BIN)/python -m tests.bench.bake_stability
	$(BIN)/python -m tests.bench.pruning
	$(BIN)/python -m tests.bench.interruptions
	$(BIN)/python -m tests.bench.reliable_share grape serpent head spot_1 --most 65536

# On a machine with a GPU: tests of its kernels, then what it does for the path tracer and the trainer. Eight minutes.
gpu: .venv/installed-dev .venv/installed-cuda
	cd tests/gpu && ../../$(BIN)/python -m pytest -p no:xdist -W default kernels
	cd tests/gpu && ../../$(BIN)/python -m pytest -p no:xdist simulated
	$(BIN)/python -m tests.on_gpu

# The network in the repository learned for 65 s on an H200 (3.0 % error); ten minutes on two cores leave 5.8 %.
# Makes the files of prt_bake/shipped again from a lat-long sky: make shipped SKY=potsdamer_platz_1k.hdr
shipped: .venv/installed-evaluate
	@test -f "$(SKY)" || { echo "prtbake: make shipped needs a sky: make shipped SKY=potsdamer_platz_1k.hdr" >&2; exit 1; }
	$(BIN)/python -m prt_bake.shipped.remake "$(SKY)"
	$(BIN)/prtbake train prt_bake/shipped/spot.toml -o prt_bake/shipped/spot.pt --minutes 60 --no-report --no-importance --force
	rm -f prt_bake/shipped/spot.train.pt
	$(BIN)/prtbake render prt_bake/shipped/spot.toml prt_bake/shipped/spot.obj --light prt_bake/shipped/sky.hdr \
		-o prt_bake/shipped/reference.exr --view three-quarter-back --size 256x256 --spp 2048 --report prt_bake/shipped/reference.json

clean:
	rm -rf .venv demo bench build dist docs/build tests/engines/node_modules $(PAGE)/vendor

# Triton interprets GPU kernels in tests on machines without a GPU. It has a separate folder: a process cannot use both its
# LLVM and that of OpenGL, and torch loads Triton wherever it finds it.
.venv/apart/installed: constraints.txt | .venv/installed-dev
	@mkdir -p .venv/apart
	@test "$$(uname -s)" != Linux || $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check --no-compile \
		--no-deps --upgrade --constraint constraints.txt --target .venv/apart triton
	@touch $@

# npm writes the stamp. Install scripts are not run: no package needs its own.
tests/engines/node_modules/.package-lock.json: tests/engines/package-lock.json
	@command -v npm >/dev/null || { echo "prtbake: npm was not found; install Node.js 20 or newer (Debian: 'sudo apt install" \
		"nodejs npm')" >&2; exit 1; }
	cd tests/engines && npm ci --ignore-scripts --no-audit --no-fund
	@touch $@

# bpy 4.5, the version with long-term support, is for Python 3.11 only.
.venv/blender/installed: | .venv/installed-dev
	@command -v python3.11 >/dev/null || { echo "prtbake: Blender 4.5 needs Python 3.11; install python3.11" >&2; exit 1; }
	python3.11 -m venv .venv/blender
	.venv/blender/bin/python -m pip install --quiet --quiet --disable-pip-version-check bpy==4.5.15
	@touch $@

# The stamp is named after the extra that is installed with the package.
.venv/installed-%: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "prtbake: no Python 3.11, 3.12 or 3.13 with the modules venv and ensurepip was found;" \
		"install one (Debian, Ubuntu: 'sudo apt install python3 python3-venv') or name it: make PYTHON=/path/to/python" >&2; \
		exit 1; }
	@echo "installing into .venv, once; this takes a minute or more"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check --no-compile \
		--constraint constraints.txt --editable '.[$*]'
# Compiles byte code on all cores; pip would use one. Tests of packages are skipped: some contain templates that are not
# valid Python.
	@$(BIN)/python -m compileall -qq -j 0 -x '/site-packages/.*/tests?/' .venv/lib >/dev/null || true
	@touch $@
