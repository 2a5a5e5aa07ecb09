"""``python -m flexroad``: the command line."""

import sys

if not sys.flags.safe_path:
    # Remove the current folder: it may have a module with the name of a library.
    del sys.path[0]

from flexroad.pipeline.cli.main import main

if __name__ == "__main__":
    main()
