# make demo   set up .venv and run ChimeraGS beside 3DGS, both compressed, on the demo scene; one table
# make test   set up .venv and run the default tests (no network, no GPU), TEST_JOBS=2 at a time
# make test-geometry  the tests that need Open3D (100 MB), which it installs; Debian's libraries: sw doctor names them
# make test-ray  the tests that need Ray (and submitit, for Slurm), which it installs
# make test-wheels  that our wheels bring their kernels: built, installed and run where no compiler is; a quarter of an hour
# make test-wasm  the decoder of .swz in WebAssembly: built again, and run in wasmtime, Node and Chromium
# make decoder-hashes  SHA-256 of what it decodes, method by method, in Python, wasmtime, Node and Chromium; some ten minutes
# make docs-site  the pages under docs/ as a site, by mkdocs-material, which it installs
# make lint   ruff and mypy
# make bench  speed and memory, as ratios measured in one run
# make kernels  compile every native module ahead of time
# make docs   docs/cli.md and the core's catalogue of packages, from what is registered

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PACKAGES := splatwizard-native splatwizard-core $(sort $(wildcard plugins/*))
PROJECTS := $(addsuffix /pyproject.toml,$(PACKAGES))
# Every training on a CPU uses them; compiled while the environment is made.
KERNELS := sw_rasterizers.native:MODULE,splatwizard_native.face_operations:POOL,splatwizard_native.fused.native:TRAINING
PIP := $(BIN)/python -m pip --disable-pip-version-check
DEMO_OUT ?= out
PYTEST_ARGS ?=
TEST_JOBS ?= 2

.PHONY: demo test test-wheels test-geometry test-ray test-browser test-interchange test-wasm decoder-hashes docs-site coverage lint format bench kernels docs clean

# Many processes import the same packages: without their bytecode each would compile them anew, torch's for 3 s.
demo test coverage: export PYTHONDONTWRITEBYTECODE =

demo: $(VENV)/.ready
	@tools/check-system compiler
	$(BIN)/sw run --method 3dgs --rate r2,r3 --scene demo --out $(DEMO_OUT)
	$(BIN)/sw run --method chimerags --scene demo --out $(DEMO_OUT)
	$(BIN)/sw report $(DEMO_OUT)/demo

test: $(VENV)/.ready-dev
	TEST_JOBS=$(TEST_JOBS) $(BIN)/python -m pytest $(PYTEST_ARGS)

test-geometry: $(VENV)/.ready-dev
	$(PIP) install -q -c constraints.txt -e 'plugins/sw-geometry[mesh,unbounded]' --no-build-isolation
	@$(BIN)/python -c 'from sw_geometry.check import check_open3d as c; x = c()[0]; exit(x.state != "ok" and f"{x.detail}: {x.mend}")'
	$(BIN)/python -m pytest -m 'not cuda' plugins/sw-geometry $(PYTEST_ARGS)

test-ray: $(VENV)/.ready-dev
	$(PIP) install -q -c constraints.txt -e 'plugins/sw-bench[ray,slurm]' --no-build-isolation
	$(BIN)/python -m pytest -m 'not cuda' plugins/sw-bench/tests/test_ray.py plugins/sw-bench/tests/test_executors.py $(PYTEST_ARGS)

# viser without its pins, which name an older rich than ours; Chromium is the system's.
test-browser: $(VENV)/.ready-dev
	$(PIP) install -q --no-deps viser==1.1.1
	$(PIP) install -q 'websockets<17' msgspec trimesh imageio requests tqdm zstandard
	$(BIN)/python -m pytest -m slow plugins/sw-view/tests/test_viewer_browser.py plugins/sw-report/tests/test_report_browser.py $(PYTEST_ARGS)

# Needs node 20 or newer; what is installed stays below build/.
test-interchange: $(VENV)/.ready-dev
	npm install --silent --prefix build/oracle @playcanvas/splat-transform@3.7.0 @sparkjsdev/spark@2.2.0 three@0.180.0
	test -d build/oracle/venv || $(PYTHON) -m venv build/oracle/venv
	build/oracle/venv/bin/pip install -q gsply==0.4.6 pygltflib==1.16.5
	$(PIP) install -q -c constraints.txt -e 'plugins/sw-interchange[usd]' --no-build-isolation
	test -d build/oracle/usd || $(PYTHON) -m venv build/oracle/usd
	build/oracle/usd/bin/pip install -q 'usd-convert-gsplat[usd]==0.1.15'
	SPLAT_TRANSFORM=build/oracle/node_modules/.bin/splat-transform GSPLY_PYTHON=build/oracle/venv/bin/python \
	SPARK_MODULES=build/oracle/node_modules USD_CONVERT_PYTHON=build/oracle/usd/bin/python \
		$(BIN)/python -m pytest -m '' plugins/sw-interchange/tests/test_other_programs.py \
		plugins/sw-interchange/tests/test_lcc.py plugins/sw-interchange/tests/test_spark.py \
		plugins/sw-interchange/tests/test_usd.py plugins/sw-interchange/tests/test_gltf.py \
		plugins/sw-lod/tests/test_splat_transform.py $(PYTEST_ARGS)

test-wheels: $(VENV)/.ready-dev
	$(PIP) install -q ziglang
	$(BIN)/python -m pytest -m slow tests/test_without_compiler.py tests/test_wasm_sources.py $(PYTEST_ARGS)

# Needs node 20 or newer and a Chromium for the tests of those; they skip without.
test-wasm: $(VENV)/.ready-dev
	$(PIP) install -q ziglang==0.17.1 wasmtime==50.0.1
	npm install --silent --prefix build/three three@0.180.0 || true
	$(BIN)/python -m pytest -m slow plugins/sw-view/tests/test_decoder.py $(PYTEST_ARGS)

decoder-hashes: $(VENV)/.ready-dev
	$(PIP) install -q wasmtime==50.0.1
	$(BIN)/python benchmarks/decoder_hashes.py

docs-site: $(VENV)/.ready-dev
	$(PIP) install -q -c constraints.txt mkdocs-material
	$(BIN)/python -m mkdocs build

coverage: $(VENV)/.ready-dev
	TEST_JOBS=$(TEST_JOBS) $(BIN)/python -m pytest --cov --cov-report=term --cov-fail-under=88 $(PYTEST_ARGS)

lint: $(VENV)/.ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.ready-dev
	$(BIN)/python benchmarks/rasterize_cpu.py
	$(BIN)/python benchmarks/training_ops.py
	$(BIN)/python benchmarks/coders.py --symbols 1000000

kernels: $(VENV)/.ready
	@tools/check-system compiler
	$(BIN)/sw build-kernels

docs: $(VENV)/.ready
	$(BIN)/python tools/cli_docs.py docs/cli.md
	$(BIN)/python tools/make_catalogue.py
	$(BIN)/python tools/record_docs.py

$(VENV)/.ready: constraints.txt $(PROJECTS)
	@PYTHON=$(PYTHON) tools/check-system python
	$(PYTHON) tools/install_packages.py --environment $(VENV) --constraint constraints.txt --kernels $(KERNELS) $(PACKAGES)
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready requirements-dev.txt
	$(PIP) install -q -c constraints.txt -r requirements-dev.txt
	@touch $@

clean:
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage*
