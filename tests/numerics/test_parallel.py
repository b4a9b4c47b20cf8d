"""One map over independent work: copies of the process, processes of their own, a cluster."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from virtual import virtual_log, write_csv

from greybox.commands.main import main
from greybox.errors import ClusterError, ExcitationError, WorkerError
from greybox.numerics.effort import seconds_left, within
from greybox.numerics.parallel import _worked, lanes, map_forked, map_pieces, on_cluster
from greybox.vessel.toml import example_vessel

# in a process of its own: a test runner has threads, and copies are then not made
FORKED = """
import os
from greybox.errors import ExcitationError
from greybox.numerics.parallel import ahead, lanes, map_forked, map_pieces

seen = []
def piece(k):
    seen.append(k)
    inner = map_forked(lambda i: (i, os.getpid()), range(3))
    return k * k, os.getpid(), len({pid for _, pid in inner} | {os.getpid()})

for mapped in (map_forked, map_pieces):
    found = list(mapped(piece, range(5)))
    assert [square for square, _, _ in found] == [0, 1, 4, 9, 16]
    assert all(alone == 1 for _, _, alone in found)
    apart = lanes() > 1
    assert apart == (os.getpid() not in {pid for _, pid, _ in found}), found
    assert seen == ([] if apart else list(range(5)))
    seen.clear()

def fails(k):
    raise ExcitationError(f"piece {k} has no model.")
try:
    map_forked(fails, range(3))
except ExcitationError as error:
    assert str(error) == "piece 0 has no model."
else:
    raise AssertionError("nothing was raised")

with ahead(lambda: [os.getpid()]) as one, ahead(lambda: fails(7)) as other:
    assert (one()[0] != os.getpid()) == apart and one() is one()
    try:
        other()
    except ExcitationError as error:
        assert str(error) == "piece 7 has no model."
    else:
        raise AssertionError("nothing was raised")

# what is computed ahead is shared among copies, and none of those shares on
with ahead(lambda: (os.getpid(), map_forked(piece, range(5)))) as shared:
    copy, found = shared()
assert len({os.getpid(), copy} | {pid for _, pid, _ in found}) > 2 or not apart
assert all(alone == 1 for _, _, alone in found)
"""
# the first worker that meets piece 3 dies at it
DYING = """
import os, sys
from pathlib import Path
from types import SimpleNamespace
from greybox.errors import WorkerError
from greybox.numerics.parallel import map_pieces

mark = Path(sys.argv[1])
def piece(k):
    if k == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    return k * k
assert list(map_pieces(piece, range(7), workers=2)) == [k * k for k in range(7)]
def always(k):
    os.kill(os.getpid(), 9)
try:
    list(map_pieces(always, range(2), workers=2))
except WorkerError as error:
    assert str(error).startswith("3 worker processes died, the last while piece 1 of 2"), error
else:
    raise AssertionError("nothing was raised")
"""
LONG = """
import os, sys, time
from pathlib import Path
from types import SimpleNamespace
from greybox.numerics.parallel import map_pieces

def piece(k):
    Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(60)
list(map_pieces(piece, range(4), workers=2))
"""


def python(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip


def square(x: int) -> int:
    return x * x


def fails(_: int) -> None:
    raise ExcitationError("no model.")


def drawn(seed: int) -> float:
    """Return what depends on the seed alone, after a while."""
    time.sleep(0.1)
    return float(np.random.default_rng(seed).normal(size=1000).sum())


def drawn_or_dead(folder: str, seed: int) -> float:
    """Return `drawn`, on any worker but the first one that meets seed 3."""
    mark = Path(folder, "dead")
    if seed == 3 and not mark.exists():
        mark.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return drawn(seed)


def test_pieces_are_computed_in_copies_that_know_everything():
    ran = python(FORKED)
    assert ran.returncode == 0, ran.stderr


def test_beside_another_thread_nothing_is_copied():
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    try:
        assert lanes() == 1
        seen: list[int] = []
        assert map_forked(lambda k: seen.append(k) or k, [3, 1, 2]) == [3, 1, 2]
        assert seen == [3, 1, 2]
        with pytest.raises(ExcitationError, match="no model"):
            map_forked(fails, [1, 2])
        # processes that are begun anew need no copy
        assert list(map_pieces(square, [3, 1, 2], workers=2)) == [9, 1, 4]
        with pytest.raises(ExcitationError, match="no model"):
            list(map_pieces(fails, [1, 2], workers=2))
    finally:
        done.set()
        other.join()


def test_the_order_is_that_of_the_pieces():
    assert list(map_pieces(square, [3, 1, 2], workers=1)) == [9, 1, 4]
    assert list(map_pieces(square, [3, 1, 2], workers=2)) == [9, 1, 4]


def test_what_a_dead_worker_had_is_computed_again_but_not_for_ever(tmp_path):
    ran = python(DYING, tmp_path / "dead")
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_the_first_process(tmp_path, how):
    first = subprocess.Popen(
        [sys.executable, "-c", LONG, str(tmp_path)], stderr=subprocess.PIPE, text=True,
        # tests in the background of a shell ignore Ctrl-C, and so would what they start
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    _until(lambda: len(list(tmp_path.iterdir())) == 2)
    workers = [int(path.name) for path in tmp_path.iterdir()]
    first.send_signal(how)
    told = first.communicate(timeout=20)[1]
    # nothing of the workers' own
    assert told.count("Traceback") == (how == signal.SIGINT)
    _until(lambda: not any(_alive(pid) for pid in workers))


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def _until(condition, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


class Cluster:
    """A scheduler and two workers without a guard, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.processes = folder, []
        self.log = folder / "scheduler"
        self._begin("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        _until(lambda: "Scheduler at" in self.log.read_text())
        self.address = re.search(r"tcp://[\d.]+:\d+", self.log.read_text())[0]
        for _ in range(2):
            self._begin("worker", self.address, "--no-nanny", "--nthreads", "1", "--no-dashboard")

    def _begin(self, *command: str) -> None:
        tests = Path(__file__).parent
        path = os.pathsep.join([str(tests), str(tests.parent), os.environ.get("PYTHONPATH", "")])
        with open(self.folder / command[0], "a") as told:
            self.processes.append(
                subprocess.Popen(
                    [sys.executable, "-m", "distributed.cli.dask_" + command[0], *command[1:]],
                    stdout=told, stderr=told, cwd=self.folder,
                    env=os.environ | {"PYTHONPATH": path},
                )
            )  # fmt: skip

    def end(self) -> None:
        for process in reversed(self.processes):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    pytest.importorskip("distributed")
    found = Cluster(tmp_path)
    yield found
    found.end()


def left(_: int) -> float:
    return seconds_left()


def own_process(_: int) -> tuple[int, int]:
    time.sleep(0.05)
    return os.getpid(), len(map_forked(square, [1, 2]))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_cluster_computes_the_same_though_a_worker_is_killed(cluster, tmp_path):
    seeds = list(range(24))
    expected = [drawn(seed) for seed in seeds]
    with on_cluster(cluster.address):
        _until(lambda: lanes() == 2)
        found = list(map_pieces(drawn, seeds))
        assert found == expected
        pids = dict(map_forked(own_process, range(8)))
        assert len(pids) == 2
        assert os.getpid() not in pids
        with within(50.0):
            assert all(0 < seconds < 50 for seconds in map_pieces(left, [1, 2]))
        with pytest.raises(ExcitationError, match="no model"):
            list(map_pieces(fails, [1, 2]))
        assert list(map_pieces(partial(drawn_or_dead, str(tmp_path)), seeds)) == expected
        assert int((tmp_path / "dead").read_text()) in pids
        assert lanes() == 1
        # the one that is left computes; where there is none, and none comes, it is told
        cluster.processes[0].kill()
        with pytest.raises(ClusterError, match=f"scheduler at '{cluster.address}' was lost"):
            list(map_pieces(drawn, seeds))
    assert issubclass(WorkerError, RuntimeError)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize(
    "command",
    ["estimate", "diagnose", "fleet", "reproduce"],
)
def test_commands_write_the_same_wherever_they_compute(
    cluster, tmp_path, command, monkeypatch, caplog
):
    logs = [str(write_csv(virtual_log(k, 400), tmp_path / f"{k}.csv")) for k in (2, 3)]
    for k in range(3 if command == "fleet" else 0):
        ship = tmp_path / "fleet" / str(k)
        ship.mkdir(parents=True)
        shutil.copy(example_vessel("thesis"), ship / "ship.toml")
        write_csv(virtual_log(k, 400), ship / "trial.csv")
    typed = {
        "fleet": ["fleet", str(tmp_path / "fleet"), "--json"],
        "estimate": ["estimate", *logs, "--vessel", "thesis", "--predictor", "basic", "--json"],
        "diagnose": ["diagnose", logs[0], "--vessel", "thesis", "--validate", logs[1], "--json"],
        "reproduce": ["reproduce", "chapter4", "--runs", "4", "--seed", "1", "--out"],
    }[command]
    here, there = tmp_path / "here", tmp_path / "there"
    assert main(["-q", *typed, str(here)]) == 0
    monkeypatch.setenv("GREYBOX_CLUSTER", cluster.address)
    with caplog.at_level("DEBUG", "greybox.numerics.parallel"):
        assert main(["-q", *typed, str(there)]) == 0
    assert f"pieces are computed at {cluster.address}" in caplog.text
    if command == "reproduce":
        assert (here / "tables.csv").read_bytes() == (there / "tables.csv").read_bytes()
        return
    first, second = (json.loads(path.read_text()) for path in (here, there))
    for found in (first, second):
        found.pop("provenance")
    assert first == second


def test_a_scheduler_that_is_not_there_is_one_sentence(tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("greybox.numerics.parallel._ANSWER", 1.0)
    options = ["reproduce", "chapter4", "--runs", "2", "--cluster", "tcp://127.0.0.1:9"]
    assert main(options) == 1
    told = capsys.readouterr().err
    assert told == (
        "greybox reproduce: no Dask scheduler answers at 'tcp://127.0.0.1:9' within 1 s: start one "
        "there with 'dask scheduler' and workers with 'dask worker tcp://127.0.0.1:9', correct the "
        "address, or leave --cluster and GREYBOX_CLUSTER out.\n"
    )


@pytest.mark.parametrize("address", ["somewhere", "tcp://host", "http://host:8786", "tcp://host:a"])
def test_what_is_no_address_is_refused_at_once(address):
    """A client that is made of it waits, and leaves a traceback behind the sentence."""
    pytest.importorskip("distributed")
    with (
        pytest.raises(ClusterError, match=f"^'{address}' is no address of a Dask scheduler, "),
        on_cluster(address),
    ):
        pass


def test_what_no_worker_is_left_to_make_is_not_waited_for(monkeypatch):
    monkeypatch.setattr("greybox.numerics.parallel._LOOK", 0.01)
    ended: list[dict] = []
    pool = SimpleNamespace(_processes={}, shutdown=lambda **how: ended.append(how))
    with pytest.raises(BrokenProcessPool, match="no worker is left"):
        _worked(pool, Future())
    assert ended == [{"kill_workers": True}]
    made = Future()
    made.set_result(3)
    assert _worked(pool, made) == 3
