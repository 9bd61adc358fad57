"""Small mistakes in the product, one at a time, and whether the tests notice.

A TOML file of this folder holds the mutations of a room. ``tests`` names the room's tests. Each
``[[file]]`` has a ``path``, the ``tests`` that should notice first, and ``mutations``: pairs of
old and new text, where the old text stands in the file once. A third text gives the reason why no
test can notice: the mutation is equivalent.

    python -m bench.mutations                     # all, resuming from out/mutations.jsonl
    python -m bench.mutations training sim --jobs 2
    python -m bench.mutations --summary           # the table alone

Each runs in a copy of the tracked files, so the checkout stays untouched. What survives its file's
tests meets the room's, then all. A killed mutation is not run again until its line leaves the
ledger.
"""
