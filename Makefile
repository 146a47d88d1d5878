# `make demo` and `make test` do all their own set-up: they need Python 3.11+, a C compiler and cargo, nothing else.
.PHONY: demo test lint bench rust-test setup clean

UV_VERSION := 0.13.8
PYTHON ?= python3
UV := .tools/bin/uv
RUN := $(UV) run --frozen

demo: setup
	$(RUN) valuemap demo

test: setup
	$(RUN) pytest

rust-test:
	cargo test --locked --package valuemap-core

lint: setup
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy
	$(RUN) lint-imports
	cargo fmt --check
	cargo clippy --locked --all-targets -- --deny warnings

bench: setup
	cargo bench --locked --package valuemap-core
	$(RUN) python benchmarks/speed.py

setup: $(UV)
	@$(UV) sync --frozen --quiet

# uv comes from the package index into a private environment, so that nothing on the machine changes.
$(UV):
	@$(PYTHON) -c 'import sys; sys.exit("valuemap needs Python 3.11 or newer, found " + sys.version.split()[0] + ": set PYTHON=...") if sys.version_info < (3, 11) else None'
	@command -v cargo >/dev/null || { echo "valuemap needs cargo (Rust 1.90 or newer) to build its core" >&2; exit 1; }
	$(PYTHON) -m venv .tools
	.tools/bin/python -m pip install --quiet uv==$(UV_VERSION)

clean:
	rm -rf .tools .venv target demo
