"""Independent float64 references and synthetic inputs for the tests.

Nothing here shares code with the packages under test: formulas are written out plainly from their definitions, slow where
slow is clearer.
"""
