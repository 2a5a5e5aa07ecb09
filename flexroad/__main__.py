"""``python -m flexroad``: the command line."""

from flexroad.pipeline.cli.main import main

if __name__ == "__main__":
    main()
