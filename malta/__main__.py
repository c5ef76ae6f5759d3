"""`python -m malta` is the program `malta`."""

from malta.cli.main import main

if __name__ == "__main__":
    main()
