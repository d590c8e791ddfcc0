"""`python -m mushpipe` is the command `mushpipe`."""

from mushpipe.cli import main

main()
