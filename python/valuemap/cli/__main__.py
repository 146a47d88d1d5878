"""`python -m valuemap.cli` is the command `valuemap`."""

from __future__ import annotations

from valuemap.cli import main

if __name__ == "__main__":
    main()
