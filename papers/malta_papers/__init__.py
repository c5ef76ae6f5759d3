"""What compares malta with papers: claims, their evidence, replicated experiments and figures.

malta finds it by the entry points of the group `malta.papers`: for each machine a package with the modules `claims`,
`experiments` and `figures`, and for the ledger the module `ledger`. malta itself imports nothing of it.
"""
