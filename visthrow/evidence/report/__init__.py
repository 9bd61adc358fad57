"""The report: one page with the paper's tables and figures beside ours, made of results of throws.

``baseline_units`` says which throws of the baseline it stands on, ``result_set`` holds the results that are there; the other
modules write a section each, which ``visthrow.view`` draws and puts together.
"""
