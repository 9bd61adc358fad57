"""The command of :mod:`bench.mutations`."""

import argparse
import hashlib
import json
import multiprocessing
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from bench.mutations import process

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).parent
LEDGER = ROOT / "out" / "mutations.jsonl"
ALL = ("tests",)
ALL_LIMIT = 2400  # s; they take 20 minutes on one core
DIGITS = re.compile(r"bits|digest|byte_for_byte|recorded")
"""Names of tests that compare with recorded digits rather than with behaviour."""
STATES = ("killed", "survived", "equivalent", "broken", "not run")


@dataclass(frozen=True)
class Mutation:
    """One mistake."""

    room: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]  # that should notice first
    room_tests: tuple[str, ...]
    equivalent: str = ""

    @property
    def key(self) -> str:
        """Digest of what is changed."""
        text = "\0".join((self.file, self.old, self.new))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def load(rooms: list[str]) -> list[Mutation]:
    """Read the mutations of rooms, of all rooms where none is named.

    Raises ValueError where an old text does not stand in its file exactly once.
    """
    mutations = []
    wrong = []
    for path in sorted(FOLDER.glob("*.toml")):
        if rooms and path.stem not in rooms:
            continue
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        for entry in table["file"]:
            source = ROOT / entry["path"]
            text = source.read_text(encoding="utf-8") if source.exists() else ""
            tests = tuple(entry["tests"]), tuple(table["tests"])
            for old, new, *reason in entry["mutations"]:
                mutation = Mutation(path.stem, entry["path"], old, new, *tests, *reason)
                mutations.append(mutation)
                if text.count(old) != 1:
                    wrong.append(f"{path.name}: {text.count(old)} times in {source}: {old!r}")
    if wrong:
        raise ValueError("expected each old text once in its file\n" + "\n".join(wrong))
    return mutations


def copy_checkout(folder: Path) -> None:
    """Copy the tracked files."""
    command = ["git", "-C", str(ROOT), "ls-files", "-z"]
    names = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)


def judge(mutation: Mutation, folder: Path, wider: bool) -> dict:
    """Run the tests on the mutated copy, of a survivor those of its room and then all, where
    ``wider``; returns a line of the ledger.
    """
    path = folder / mutation.file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
    start = time.time()
    state, test = process.outcome(folder, mutation.tests)
    if state == "survived" and wider:
        state, test = process.outcome(folder, mutation.room_tests)
    if state == "survived" and wider:
        state, test = process.outcome(folder, ALL, ALL_LIMIT)
    path.write_text(text, encoding="utf-8")
    return {
        "key": mutation.key,
        "room": mutation.room,
        "file": mutation.file,
        "old": mutation.old,
        "new": mutation.new,
        "state": state,
        "by": test,
        "seconds": round(time.time() - start, 1),
    }


def work(todo: "queue.Queue[Mutation]", ledger: Path, wider: bool, lock: threading.Lock) -> None:
    """Judge mutations until none is left, in a copy of the checkout."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "visthrow"
        copy_checkout(folder)
        while True:
            try:
                mutation = todo.get_nowait()
            except queue.Empty:
                return
            line = judge(mutation, folder, wider)
            with lock, open(ledger, "a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
                shown = f"{line['state']:9} {line['seconds']:6.1f} s  {mutation.file}"
                print(f"{shown}  {mutation.new!r}  {line['by']}", flush=True)


def read_ledger(ledger: Path) -> dict[str, dict]:
    """Read the last line of each mutation, by key."""
    if not ledger.exists():
        return {}
    lines = map(json.loads, ledger.read_text(encoding="utf-8").splitlines())
    return {line["key"]: line for line in lines}


def summary(mutations: list[Mutation], lines: dict[str, dict]) -> str:
    """Return a table by room, and each survivor."""
    rooms: dict[str, Counter[str]] = {}
    survivors = []
    for mutation in mutations:
        line = lines.get(mutation.key, {"state": "not run", "by": ""})
        state = "equivalent" if mutation.equivalent else line["state"]
        for room in (mutation.room, "all"):
            counts = rooms.setdefault(room, Counter())
            counts[state] += 1
            counts["by digits"] += bool(DIGITS.search(line["by"]))
        if state in ("survived", "broken"):
            survivors.append(f"{state}: {mutation.file}: {mutation.old!r} -> {mutation.new!r}")
    columns = [*STATES, "by digits"]
    rows = [f"{'room':15}" + "".join(f"{name:>12}" for name in columns)]
    for room, counts in rooms.items():
        rows.append(f"{room:15}" + "".join(f"{counts[name]:12}" for name in columns))
    return "\n".join([*rows, *survivors])


def main() -> int:
    """Run the command; exit status 1 where a mutation survived."""
    parser = argparse.ArgumentParser(prog="python -m bench.mutations", description=__doc__)
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help="TOML files, by stem")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--ledger", type=Path, default=LEDGER)
    parser.add_argument("--first", action="store_true", help="run no tests but the file's")
    parser.add_argument("--summary", action="store_true", help="print the table alone")
    args = parser.parse_args()
    mutations = load(args.rooms)
    args.ledger.parent.mkdir(parents=True, exist_ok=True)
    if not args.summary:
        done = {key for key, line in read_ledger(args.ledger).items() if line["state"] == "killed"}
        todo: queue.Queue[Mutation] = queue.Queue()
        for mutation in mutations:
            if not mutation.equivalent and mutation.key not in done:
                todo.put(mutation)
        print(f"{todo.qsize()} of {len(mutations)} mutations to run", flush=True)
        multiprocessing.get_context("forkserver").set_forkserver_preload(process.HEAVY)
        lock = threading.Lock()
        task = (todo, args.ledger, not args.first, lock)
        workers = [threading.Thread(target=work, args=task) for _ in range(args.jobs)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    lines = read_ledger(args.ledger)
    print(summary(mutations, lines))
    return int(any(lines.get(m.key, {}).get("state") == "survived" for m in mutations))


if __name__ == "__main__":
    sys.exit(main())
