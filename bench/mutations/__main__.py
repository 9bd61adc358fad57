"""The command of :mod:`bench.mutations`."""

import argparse
import hashlib
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(__file__).parent
LEDGER = ROOT / "out" / "mutations.jsonl"
DIGITS = re.compile(r"bits|digest|byte_for_byte|recorded")
"""Names of tests that compare with recorded digits rather than with behaviour."""
LIMIT = 600  # s, for the tests of one mutation
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Mutation:
    """One mistake."""

    room: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    equivalent: str = ""

    @property
    def key(self) -> str:
        """Digest of the mutation and of the file that it changes."""
        text = (ROOT / self.file).read_text(encoding="utf-8")
        parts = (self.file, self.old, self.new, *self.tests, text)
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def load(rooms: list[str]) -> list[Mutation]:
    """Read the mutations of rooms, of all rooms where none is named.

    Raises ValueError where ``old`` does not stand in its file exactly once."""
    found = []
    for path in sorted(FOLDER.glob("*.toml")):
        if rooms and path.stem not in rooms:
            continue
        for row in tomllib.loads(path.read_text(encoding="utf-8"))["mutation"]:
            tests = tuple(row.pop("tests", ()))
            mutation = Mutation(path.stem, tests=tests, **row)
            count = (ROOT / mutation.file).read_text(encoding="utf-8").count(mutation.old)
            if count != 1:
                raise ValueError(f"{path.name}: {mutation.old!r} is {count} times in {row['file']}")
            found.append(mutation)
    return found


def copy_of_checkout(folder: Path) -> None:
    """Copy the tracked files."""
    names = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, text=True, check=True
    ).stdout
    for name in filter(None, names.split("\0")):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)


def judge(mutation: Mutation, folder: Path) -> dict:
    """Run the tests on the mutated copy; returns a line of the ledger."""
    path = folder / mutation.file
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    start, killer = time.time(), ""
    try:
        done = subprocess.run(
            [*command, *mutation.tests],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
        state = "survived" if done.returncode == 0 else "killed"
        match = FAILED.search(done.stdout)
        killer = match[1] if match else ""
        if state == "killed" and not killer:
            state = "broken"
    except subprocess.TimeoutExpired:
        state, killer = "killed", "time limit"
    finally:
        path.write_text(text, encoding="utf-8")
    seconds = round(time.time() - start, 1)
    line = {"key": mutation.key, "room": mutation.room, "file": mutation.file}
    return {**line, "new": mutation.new, "state": state, "by": killer, "seconds": seconds}


def work(todo: "queue.Queue[Mutation]", ledger: Path, lock: threading.Lock) -> None:
    """Judge mutations until none is left, in a copy of the checkout."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "visthrow"
        copy_of_checkout(folder)
        while True:
            try:
                mutation = todo.get_nowait()
            except queue.Empty:
                return
            line = judge(mutation, folder)
            with lock, open(ledger, "a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
                print(f"{line['state']:9} {line['seconds']:6.1f} s  {mutation.file}  {line['by']}")


def known(ledger: Path) -> dict[str, dict]:
    """Read the ledger by key."""
    if not ledger.exists():
        return {}
    lines = map(json.loads, ledger.read_text(encoding="utf-8").splitlines())
    return {line["key"]: line for line in lines}


def summary(mutations: list[Mutation], lines: dict[str, dict]) -> str:
    """Return a table by room, and each survivor."""
    rows = ["room            killed  by digits  survived  equivalent  not run"]
    survivors = []
    for room in sorted({m.room for m in mutations}):
        own = [m for m in mutations if m.room == room]
        states = [
            ("equivalent" if m.equivalent else lines.get(m.key, {}).get("state")) for m in own
        ]
        digits = sum(bool(DIGITS.search(lines.get(m.key, {}).get("by", ""))) for m in own)
        rows.append(
            f"{room:15} {states.count('killed'):6}  {digits:9}  {states.count('survived'):8}"
            f"  {states.count('equivalent'):10}  {states.count(None):7}"
        )
        survivors += [
            f"survived: {m.file}: {m.old!r} -> {m.new!r}"
            for m, s in zip(own, states)
            if s == "survived"
        ]
    return "\n".join([*rows, *survivors])


def main() -> int:
    """Run the command; exit status 1 where a mutation survived."""
    parser = argparse.ArgumentParser(prog="python -m bench.mutations", description=__doc__)
    parser.add_argument(
        "rooms", nargs="*", metavar="ROOM", help="files of bench/mutations, by stem"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--ledger", type=Path, default=LEDGER)
    parser.add_argument("--summary", action="store_true", help="print the table alone")
    args = parser.parse_args()
    mutations = load(args.rooms)
    args.ledger.parent.mkdir(parents=True, exist_ok=True)
    if not args.summary:
        done, todo = known(args.ledger), queue.Queue()
        for mutation in mutations:
            if not mutation.equivalent and mutation.key not in done:
                todo.put(mutation)
        print(f"{todo.qsize()} of {len(mutations)} mutations to run")
        lock = threading.Lock()
        workers = [
            threading.Thread(target=work, args=(todo, args.ledger, lock)) for _ in range(args.jobs)
        ]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    lines = known(args.ledger)
    print(summary(mutations, lines))
    return int(any(lines.get(m.key, {}).get("state") == "survived" for m in mutations))


if __name__ == "__main__":
    sys.exit(main())
