"""`python -m mushpipe` is the command `mushpipe`."""

from mushpipe.cli import main

if __name__ == "__main__":
    main()
