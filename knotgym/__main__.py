"""`python -m knotgym` is the command `knotgym`."""

from knotgym.cli import main

if __name__ == "__main__":
    main()
