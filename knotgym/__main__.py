"""`python -m knotgym` is the command `knotgym`."""

from knotgym.cli.main import main

if __name__ == "__main__":
    main()
