"""The ships of a fleet folder: one folder a ship, with its vessel file and its logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from greybox.errors import GreyboxError, LogError, VesselError, so_many
from greybox.fleet.differing import FEWEST
from greybox.vessel.toml import load_vessel
from greybox.vessel.vessel import Vessel

_LOGS = (".csv", ".parquet", ".pq")


@dataclass(frozen=True)
class ShipFiles:
    """What is known of one ship before its logs are read.

    Parameters
    ----------
    name : str
        Of its folder.
    vessel : Vessel
    logs : tuple of Path
        In the order of their names.
    """

    name: str
    vessel: Vessel
    logs: tuple[Path, ...]


@dataclass(frozen=True)
class LeftOut:
    """A ship that takes no part, and why."""

    ship: str
    reason: str

    @property
    def sentence(self) -> str:
        """The same as a sentence."""
        return f"ship '{self.ship}' was left out: {self.reason}"


def find_ships(folder: str | Path) -> tuple[list[ShipFiles], list[LeftOut]]:
    """Return the ships of a fleet folder, and those whose files cannot be used.

    Parameters
    ----------
    folder : str or Path
        Has a folder for each ship, with one vessel file (TOML) and logs (CSV, Parquet). Folders
        without either are no ships; what begins with a dot is not looked at.

    Raises
    ------
    LogError
        There is no such folder, or it has fewer than three ships.
    VesselError
        A ship is of another class than the others.
    """
    place = Path(folder)
    if not place.is_dir():
        raise LogError(
            f"'{folder}' is no folder: name one that holds a folder for each ship, with its vessel "
            f"file and logs."
        )
    ships: list[ShipFiles] = []
    left_out: list[LeftOut] = []
    for name, vessels, logs in _folders(place):
        try:
            ships.append(ShipFiles(name, _vessel(vessels, logs), tuple(logs)))
        except (GreyboxError, OSError) as error:
            left_out.append(LeftOut(name, str(error)))
    require_ships([s.name for s in ships], left_out, str(folder))
    _require_one_class(ships)
    return ships, left_out


def fleet_files(folder: str | Path) -> list[Path]:
    """Return the vessel files and logs of a fleet folder, ship by ship."""
    return [p for _, vessels, logs in _folders(Path(folder)) for p in (*vessels, *logs)]


def _folders(place: Path) -> Iterator[tuple[str, list[Path], list[Path]]]:
    """Yield name, vessel files and logs of each folder that has any, in the order of names."""
    for inside in sorted(p for p in place.iterdir() if p.is_dir() and p.name[0] != "."):
        files = sorted(p for p in inside.iterdir() if p.is_file() and p.name[0] != ".")
        vessels = [p for p in files if p.suffix == ".toml"]
        logs = [p for p in files if p.suffix in _LOGS]
        if vessels or logs:
            yield inside.name, vessels, logs


def require_ships(ships: Sequence[str], left_out: Sequence[LeftOut], folder: str) -> None:
    """Raise where there are too few ships to be compared.

    Raises
    ------
    LogError
        Names those there are, and why others were left out.
    """
    if len(ships) >= FEWEST:
        return
    named = f" ({', '.join(ships)})" if ships else ""
    told = "".join(f" {one.sentence}" for one in left_out) or (
        " Each ship is a folder directly in it, with one vessel file (*.toml) and that ship's logs."
    )
    raise LogError(
        f"'{folder}' has {so_many(len(ships), 'ship')}{named} that can be used, and at least "
        f"{FEWEST} are "
        f"needed to see how much ships of a class differ.{told} Use greybox estimate for each ship."
    )


def _vessel(vessels: Sequence[Path], logs: Sequence[Path]) -> Vessel:
    if len(vessels) != 1:
        raise VesselError(
            f"its folder has {so_many(len(vessels), 'vessel file')} (*.toml): keep exactly 1 there."
        )
    if not logs:
        raise LogError("its folder has no logs (*.csv, *.parquet): put at least 1 there.")
    return load_vessel(vessels[0])


def _thrusters(vessel: Vessel) -> str:
    """Return types and columns of the thrusters in words."""
    return ", ".join(f"{t.type} ({', '.join(t.columns)})" for t in vessel.thrusters)


def _require_one_class(ships: Sequence[ShipFiles]) -> None:
    """Raise where thrusters differ in type or columns between ships."""
    found = {ship.name: _thrusters(ship.vessel) for ship in ships}
    usual = Counter(found.values()).most_common(1)[0][0]
    other = next((name for name, thrusters in found.items() if thrusters != usual), None)
    if other is not None:
        like = sum(thrusters == usual for thrusters in found.values())
        raise VesselError(
            f"ship '{other}' has the thrusters {found[other]}, and {like} of {len(ships)} ships "
            f"have {usual}: a fleet is of one class, so move the folder '{other}' elsewhere, or "
            f"give its vessel file the same types and columns."
        )
