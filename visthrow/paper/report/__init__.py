"""Write the report: one page with the paper's tables and figures and ours, from results of throws.

``result_set`` holds the available results. Each of the other modules writes a section or two, which
``visthrow.view`` draws and assembles."""
