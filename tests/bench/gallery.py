"""How often each flaw of the gallery is found: `python tests/bench/gallery.py [FLAW ...]`, twenty seeds each.

The tests end a flaw's trial after five hits in a row; this prints the whole table. It takes some three minutes.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from test_flawed import FLAWED, found, table

from viz_estim.errors import BadInput
from viz_estim.running import find

SEEDS = 20


def main(names: list[str]) -> int:
    try:
        for name in names:
            find(f"flawed:{name}")
    except BadInput as error:
        print(error, file=sys.stderr)
        return 2
    codes = {name: found(name, range(SEEDS)) for name in names or FLAWED}
    print(table(codes))
    hits = sum(FLAWED[name].code in seed for name, seeds in codes.items() for seed in seeds)
    print(f"{hits} of {SEEDS * len(codes)} ({hits / (SEEDS * len(codes)):.1%})")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
