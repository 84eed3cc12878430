"""Write the documentation of the public API as HTML: python docs/make_api.py FOLDER.

pdoc reads a module's dictionary, in which the names that `tumble` imports at first use are not there yet.
"""

import sys
from pathlib import Path

import pdoc

import tumble

if __name__ == "__main__":
    vars(tumble).update({name: getattr(tumble, name) for name in tumble.__all__})
    pdoc.pdoc("tumble", output_directory=Path(sys.argv[1]))
