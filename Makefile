# Two commands do everything on a fresh Debian with git, make and python3: `make demo` and `make test`.
.PHONY: setup setup-tests demo serve test test-shapes test-slow test-nightly test-laboratory check coverage format bench dependencies reference results pictures docs sbom audit mutants
BIN := .venv/bin
# The tests start many processes: with compiled modules kept beside them each starts in half the time.
unexport PYTHONDONTWRITEBYTECODE
# A test goes to the core that is free. In CI the longest are printed.
PYTEST = $(BIN)/pytest -n 2 --dist worksteal $(if $(filter true,$(CI)),--durations=50)
UV = $(shell command -v uv || echo $${XDG_CACHE_HOME:-$$HOME/.cache}/eigenhead/uv)

setup:       ## uv, the locked environment, an EGL; nothing where nothing is missing
	@deploy/setup.sh

setup-tests: ## also the Debian packages without which some tests skip
	@deploy/setup.sh --tests

demo:        ## the main job: simulated rig, capture, service, textured head in out/demo
	@deploy/setup.sh --quick
	$(BIN)/eigenhead demo --out out/demo

serve: setup ## the service with its data in out/data
	$(BIN)/eigenhead serve --data out/data

test: setup  ## the fast tests
	$(PYTEST)

test-shapes: setup  ## calls of the rooms below the server, held to their annotated types and shapes; SHAPES=all: every parameter set
	$(PYTEST) --shapes $(or $(SHAPES),once) tests/calibration tests/pipeline tests/rig tests/test_shape_checks.py

test-slow: setup  ## the tests that take more than a second each
	$(PYTEST) -m "slow and not nightly"

test-nightly: setup  ## these, and in full size what they hold in a smaller one
	$(PYTEST) -m slow

test-laboratory: setup  ## the tests of experiments, benchmarks and model files, slow ones too: before a release
	$(BIN)/pytest -m "slow or not slow" -n 2 tests/laboratory/tests

check: ## ruff, pyright, import-linter, biome (JavaScript), dead links of the documents
	@deploy/setup.sh --docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python --threads 2
	$(BIN)/lint-imports
	@if [ -x $(BIN)/biome ]; then $(BIN)/biome ci; else echo "check: skipped: no biome for this machine, JavaScript is not checked"; fi
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

coverage: setup ## what share of the product's lines the fast tests run, child processes included, compiled loops left out
	@mkdir -p out/coverage && rm -f out/coverage/data*
	$(BIN)/coverage run -m pytest -n 2 --dist worksteal
	$(BIN)/coverage combine -q
	$(BIN)/coverage report --skip-covered --sort=cover

format:
	@deploy/setup.sh --docs
	$(BIN)/ruff check --fix --select I .
	$(BIN)/ruff format .
	@if [ -x $(BIN)/biome ]; then $(BIN)/biome format --write; else echo "format: skipped: no biome for this machine, JavaScript is as it was"; fi

bench: setup ## timings of inner loops
	$(BIN)/pytest -o addopts="-ra --strict-markers --import-mode=importlib -p no:jaxtyping" tests/laboratory/benchmarks

dependencies: setup ## docs/dependencies.md: every locked package with licence and reason
	$(BIN)/python -m tests.tools.dependencies

reference: setup ## pages that are made of the program: commands, environment variables, settings
	$(BIN)/python -m tests.tools.reference

results: setup ## the documents' tables from docs/results/; with TABLE=name that table's command is run first (it may take hours)
	$(BIN)/python -m tests.tools.results $(TABLE)

pictures: demo ## docs/pictures from what the demo made
	$(BIN)/python -m tests.tools.pictures

docs: ## the documents as a site, out/site
	@deploy/setup.sh --docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

sbom: setup ## what an installation is made of: CycloneDX, out/sbom.json
	@mkdir -p out
	$(UV) export --locked --quiet --no-default-groups --all-extras --format cyclonedx1.5 --output-file out/sbom.json >/dev/null

audit: setup ## known faults of the locked packages, asked of osv.dev; fails where it cannot ask
	$(UV) audit --locked --preview-features audit

mutants: setup ## MODULE=rig/geometry.py: changes code and tells what no test notices
	$(UV) sync --locked --quiet --group docs --group mutants
	$(BIN)/python -m tests.tools.mutants $(MODULE)
