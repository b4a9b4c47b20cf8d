"""Write the logs of a foreign ship: ``python -m foreign_ships SHIP MANOEUVRE... --out DIR``."""

from __future__ import annotations

import argparse

from foreign_ships.manoeuvres import kinds
from foreign_ships.presets import presets, write_campaign

parser = argparse.ArgumentParser(prog="foreign_ships", description="write a foreign ship's logs")
parser.add_argument("ship", choices=sorted(presets()))
parser.add_argument("manoeuvres", nargs="+", choices=sorted(kinds()), metavar="manoeuvre")
parser.add_argument("--out", required=True, help="folder of the vessel file and the logs")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--weather", type=float, default=0.0, help="0 is calm, 1 a fresh breeze")
parser.add_argument("--waves", action="store_true")
parser.add_argument("--every", type=int, default=1, help="write every so many samples")
parser.add_argument("--thrust", help="thrust law of the vessel file")
given = vars(parser.parse_args())
vessel, logs = write_campaign(given.pop("out"), given.pop("ship"), given.pop("manoeuvres"), **given)
print(vessel, *logs, sep="\n")
