"""Drop a dataset here: one file with `load(path) -> Capture` and `load_truth(path) -> Truth | None`.

The two are apart so that a reconstruction cannot read what it is later scored against.
"""
