"""The report: one page with the paper's tables and figures beside ours, made of results of throws.

``wanted`` says which throws it stands on, ``book`` holds the results that are there, ``figures`` draws, ``sections`` writes
the parts, ``page`` puts them together, ``command`` is the subcommand.
"""
