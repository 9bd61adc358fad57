"""Small mistakes in the product, one at a time, and whether the tests notice.

A mutation is a table of a TOML file in this folder: ``file``, ``old`` and ``new`` text, and
``tests`` that should fail. ``equivalent`` gives the reason why no test can. ``old`` must stand in
the file once.

    python -m bench.mutations                     # all, resuming from out/mutations.jsonl
    python -m bench.mutations hil sim --jobs 2    # two files
    python -m bench.mutations --summary           # the table alone

Each runs in a copy of the tracked files, so the checkout stays untouched.
"""
