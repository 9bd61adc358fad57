"""The report: one page with the paper's tables and figures beside ours, made of results of throws.

``result_set`` holds the results that are there; the other modules write a section or two each,
which ``visthrow.view`` draws and puts together."""
