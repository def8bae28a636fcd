"""`python -m driftlab`."""

from driftlab.cli import main

if __name__ == "__main__":
    main()
