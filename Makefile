# `make demo` and `make test` do all their own set-up: they need Python 3.11+, a C compiler and cargo, nothing else.
# `make test EXTRAS=train` installs PyTorch (5 GB) and tests training too; without it those tests are skipped.
.PHONY: demo test lint bench bench-field bench-scale model page rust-test fuzz wheel sdist docs setup clean

UV_VERSION := 0.13.8
PYTHON ?= python3
UV := .tools/bin/uv
RUN := $(UV) run --frozen
EXTRAS ?=
DETECTOR_DATA ?= ../shared/data/detector
FIELD_DATA ?= ../shared/data

demo: setup
	$(RUN) valuemap demo

# A file is tried in one process, for what its tests share; in the order of the names, but for the longest (tests/conftest.py).
test: setup
	EXTRAS="$(EXTRAS)" $(RUN) pytest --numprocesses auto --dist loadfile --no-loadscope-reorder

rust-test:
	cargo test --locked --package valuemap-core

# Spoiled input through the readers, the tables, the settings and the border of the core; `make rust-test` has some
# of the core's own. All of it, by the million: see benchmarks/README.md.
fuzz: setup
	$(RUN) python benchmarks/fuzz.py --cases 20000

lint: setup
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy
	$(RUN) lint-imports
	cargo fmt --check
	cargo clippy --locked --all-targets -- --deny warnings
	RUSTDOCFLAGS="--deny warnings --document-private-items" cargo doc --locked --no-deps --package valuemap-core

# valuemap and other methods on the same real data: see benchmarks/README.md.
bench-field: setup
	$(RUN) python benchmarks/field.py $(FIELD_DATA) --peers benchmarks/results/field.md

bench: setup
	cargo bench --locked --package valuemap-core
	$(RUN) python benchmarks/speed.py

# Cities larger than memory, tiles of any size, runs that are killed, changes between years, updates. The last, a map
# of ten times nyc, takes hours.
bench-scale: setup
	$(RUN) python benchmarks/scale.py simulate --preset 10x-nyc --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py partition --preset 10x-nyc --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py cells --preset block --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py kills --preset block --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py change --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py cells --preset nyc --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py kills --preset nyc --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py tiles --preset nyc --json benchmarks/results/scale.json
	$(RUN) python benchmarks/scale.py update --preset nyc --json benchmarks/results/scale.json
	$(RUN) python benchmarks/on_ray.py --json benchmarks/results/on_ray.json
	$(RUN) python benchmarks/scale.py map --preset 10x-nyc --json benchmarks/results/scale.json

# The bundled model of traffic lights, from rendered and real pictures: see docs/model_card.md.
model: EXTRAS := train
model: setup
	$(RUN) python benchmarks/bundled_model.py $(DETECTOR_DATA)/tl_kr --work target/model \
		--dtld $(DETECTOR_DATA)/dtld --json benchmarks/results/bundled_model.json

# The page of valuemap view, from viewer/ into the package: needs Node.js, and only after a change of it.
page:
	cd viewer && npm ci --no-audit --no-fund && npm run build

# An abi3 wheel for every Python from 3.11 on, in dist/. On Linux zig links it for glibc 2.28, as old as what the
# wheels that it depends on need, wherever it is built. .ci/try_wheel.py tries it without a compiler.
MATURIN := $(UV) tool run --with ziglang==0.17.0 maturin@1.16.0
wheel: $(UV)
	$(MATURIN) build --release --locked --out dist $(if $(filter Linux,$(shell uname -s)),--zig --compatibility manylinux_2_28)

# The pages of docs/ as a site in build/site that needs no network; a link that leads nowhere is an error.
docs: $(UV)
	$(UV) run --frozen --isolated --only-group docs env NO_MKDOCS_2_WARNING=1 mkdocs build --strict --quiet

sdist: $(UV)
	$(MATURIN) sdist --out dist

setup: $(UV)
	@$(UV) sync --frozen --quiet $(EXTRAS:%=--extra %)

# uv comes from the package index into a private environment, so that nothing on the machine changes.
$(UV):
	@$(PYTHON) -c 'import sys; sys.exit("valuemap needs Python 3.11 or newer, found " + sys.version.split()[0] + ": set PYTHON=...") if sys.version_info < (3, 11) else None'
	@command -v cargo >/dev/null || { echo "valuemap needs cargo (Rust 1.90 or newer) to build its core" >&2; exit 1; }
	$(PYTHON) -m venv .tools
	.tools/bin/python -m pip install --quiet uv==$(UV_VERSION)

clean:
	rm -rf .tools .venv target demo
