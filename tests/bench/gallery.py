"""How often each flaw of the gallery is found: `python tests/bench/gallery.py [FLAW ...]`, twenty seeds each.

The tests end a flaw's trial after five hits in a row; this prints the whole table. It takes some five minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from test_flawed import FLAWED, found, table

SEEDS = 20


def main(names: list[str]) -> None:
    codes = {name: found(name, range(SEEDS)) for name in names or FLAWED}
    print(table(codes))
    hits = sum(FLAWED[name].code in seed for name, seeds in codes.items() for seed in seeds)
    print(f"{hits} of {SEEDS * len(codes)} ({hits / (SEEDS * len(codes)):.1%})")


if __name__ == "__main__":
    main(sys.argv[1:])
